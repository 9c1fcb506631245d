"""Laws of form, the same for every role: a description with defaults, and pure functions over arrays."""

import dataclasses
import json
import pickle
from collections.abc import Callable
from typing import Any, get_type_hints

import numpy as np
from numpy.typing import NDArray
from pydantic.fields import FieldInfo

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.plugin.roles import ROLES
from evlcp_sdk.specs import make_model
from evlcp_sdk.testing.exercises import compile_on, link_of, make_exercise
from evlcp_sdk.testing.law import LawError, Subject, expect, expect_same, law
from evlcp_sdk.testing.trees import map_arrays

_SAME = 1e-5
"""Tolerance of sums in another order: single precision."""


def _get_parameters(subject: Subject) -> list[dataclasses.Field[Any]]:
    expect(dataclasses.is_dataclass(subject.algorithm), "a dataclass")
    return [f for f in dataclasses.fields(subject.algorithm) if f.init]


@law("defaults", "every parameter has a default, and the class fills its role")
def _check_defaults(subject: Subject) -> None:
    cls = type(subject.algorithm)
    abstract = ROLES[subject.role].abstract
    expect(isinstance(subject.algorithm, abstract), f"an instance of {abstract.__name__}")
    for f in _get_parameters(subject):
        bare = f.default is dataclasses.MISSING and f.default_factory is dataclasses.MISSING
        expect(not bare, f"a default of field {f.name!r}")
    expect(cls() == cls(), "two algorithms with all defaults to be equal")


@law("frozen", "a frozen, hashable dataclass")
def _check_frozen(subject: Subject) -> None:
    _get_parameters(subject)
    expect(subject.algorithm.__dataclass_params__.frozen, "@dataclass(frozen=True)")
    same = hash(subject.algorithm) == hash(dataclasses.replace(subject.algorithm))
    expect(same, "equal ones to hash equal")


@law("described", "class and parameters have descriptions")
def _check_descriptions(subject: Subject) -> None:
    cls = type(subject.algorithm)
    own = cls.__dict__.get("__doc__") or ""
    expect(own.strip() and not own.startswith(f"{cls.__name__}("), f"a docstring of class {cls.__name__}")
    hints = get_type_hints(cls, include_extras=True)
    for f in _get_parameters(subject):
        notes = getattr(hints[f.name], "__metadata__", ())
        has_description = any(isinstance(n, FieldInfo) and n.description for n in notes)
        expect(has_description, f"field {f.name!r} as Annotated[..., Field(description=...)]")


@law("round-trip", "parameters come back equal from JSON, as the configuration reads them")
def _check_json(subject: Subject) -> None:
    _get_parameters(subject)
    cls = type(subject.algorithm)
    model = make_model(cls)
    text = json.dumps(dataclasses.asdict(subject.algorithm), allow_nan=False)
    values = model.model_validate_json(text)
    again = cls(**{name: getattr(values, name) for name in model.model_fields})
    expect(again == subject.algorithm, f"{subject.algorithm!r} from its JSON {text}, got {again!r}")


@law("picklable", "comes back equal from pickle, as workers get it")
def _check_pickle(subject: Subject) -> None:
    again = pickle.loads(pickle.dumps(subject.algorithm))
    expect(again == subject.algorithm, f"{subject.algorithm!r} from its pickle, got {again!r}")


@law("compiles", "compiles for the camera, bar and codebook of the link")
def _check_compile(subject: Subject) -> None:
    try:
        compile_on(subject, link_of(subject))
    except ConfigError as refused:
        owner = "the default" if subject.link is None else "the link's"
        raise LawError(f"expected {owner} camera, bar and codebook to do, got: {refused}") from refused


@law("inputs-kept", "arrays that it is given stay as they were")
def _check_inputs_kept(subject: Subject) -> None:
    inputs, prepare = make_exercise(subject)
    copies = map_arrays(inputs, np.copy)
    prepare()(*copies)
    expect_same(copies, inputs, "inputs to stay as they were", name="input")


def _expect_same_from(subject: Subject, change: Callable[[NDArray[Any]], NDArray[Any]], kind: str) -> None:
    inputs, prepare = make_exercise(subject)
    wanted = prepare()(*map_arrays(inputs, np.copy))
    got = prepare()(*map_arrays(inputs, change))
    expect_same(got, wanted, f"the same result from {kind}", _SAME)


@law("read-only", "takes read-only arrays")
def _check_read_only(subject: Subject) -> None:
    def lock(array: NDArray[Any]) -> NDArray[Any]:
        out = array.copy()
        out.setflags(write=False)
        return out

    _expect_same_from(subject, lock, "read-only arrays")


@law("non-contiguous", "takes arrays whose elements do not lie side by side")
def _check_strided(subject: Subject) -> None:
    def stride(array: NDArray[Any]) -> NDArray[Any]:
        return array.repeat(2, axis=-1)[..., ::2]

    _expect_same_from(subject, stride, "arrays that are not contiguous")


@law("deterministic", "equal inputs give equal results, without global random numbers")
def _check_deterministic(subject: Subject) -> None:
    inputs, prepare = make_exercise(subject)
    before = np.random.get_state()  # noqa: NPY002
    try:
        np.random.seed(1)  # noqa: NPY002
        run = prepare()
        first = map_arrays(run(*inputs), np.copy)
        np.random.seed(2)  # noqa: NPY002
        start = pickle.dumps(np.random.get_state())  # noqa: NPY002
        expect_same(run(*inputs), first, "the same result when called again")
        expect_same(prepare()(*inputs), first, "the same result when compiled again")
        end = pickle.dumps(np.random.get_state())  # noqa: NPY002
        expect(start == end, "NumPy's global random numbers to stay untouched: take a Generator")
    finally:
        np.random.set_state(before)  # noqa: NPY002


@law("results-owned", "what it returns is the caller's to change")
def _check_results_owned(subject: Subject) -> None:
    def clear(array: NDArray[Any]) -> NDArray[Any]:
        if array.flags.writeable:
            array[...] = 0
        return array

    inputs, prepare = make_exercise(subject)
    run = prepare()
    first = run(*inputs)
    wanted = map_arrays(first, np.copy)
    map_arrays(first, clear)
    expect_same(run(*inputs), wanted, "a result that is changed by the caller not to change the next")


DESCRIPTION = (_check_defaults, _check_frozen, _check_descriptions, _check_json, _check_pickle)
"""Laws of the description."""

FUNCTION = (_check_compile, _check_inputs_kept, _check_read_only, _check_strided)
"""Laws of roles that take arrays."""

RESULT = (_check_deterministic, _check_results_owned)
"""Laws of what any role returns."""

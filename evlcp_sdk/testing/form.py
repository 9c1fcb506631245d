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
from evlcp_sdk.testing.exercises import arguments_of, compile_given, exercise_of
from evlcp_sdk.testing.law import LawError, Subject, expect, expect_same, law
from evlcp_sdk.testing.trees import map_arrays

_SAME = 1e-5
"""Tolerance where the order of a sum may change: single precision."""


def _parameters(subject: Subject) -> list[dataclasses.Field[Any]]:
    expect(dataclasses.is_dataclass(subject.algorithm), "a dataclass")
    return [f for f in dataclasses.fields(subject.algorithm) if f.init]


@law("defaults", "every parameter has a default, and the class fills its role")
def _defaults(subject: Subject) -> None:
    cls = type(subject.algorithm)
    abstract = ROLES[subject.role].abstract
    expect(isinstance(subject.algorithm, abstract), f"an instance of {abstract.__name__}")
    for f in _parameters(subject):
        bare = f.default is dataclasses.MISSING and f.default_factory is dataclasses.MISSING
        expect(not bare, f"a default of field {f.name!r}")
    expect(cls() == cls(), "two algorithms with all defaults to be equal")


@law("frozen", "a frozen, hashable dataclass")
def _frozen(subject: Subject) -> None:
    _parameters(subject)
    expect(subject.algorithm.__dataclass_params__.frozen, "@dataclass(frozen=True)")
    same = hash(subject.algorithm) == hash(dataclasses.replace(subject.algorithm))
    expect(same, "equal ones to hash equal")


@law("described", "class and parameters say what they are")
def _described(subject: Subject) -> None:
    cls = type(subject.algorithm)
    own = cls.__dict__.get("__doc__") or ""
    expect(own.strip() and not own.startswith(f"{cls.__name__}("), f"a docstring of class {cls.__name__}")
    hints = get_type_hints(cls, include_extras=True)
    for f in _parameters(subject):
        notes = getattr(hints[f.name], "__metadata__", ())
        described = any(isinstance(n, FieldInfo) and n.description for n in notes)
        expect(described, f"field {f.name!r} as Annotated[..., Field(description=...)]")


@law("round-trip", "parameters come back equal from JSON, as the configuration reads them")
def _round_trip(subject: Subject) -> None:
    _parameters(subject)
    cls = type(subject.algorithm)
    model = make_model(cls)
    text = json.dumps(dataclasses.asdict(subject.algorithm), allow_nan=False)
    values = model.model_validate_json(text)
    again = cls(**{name: getattr(values, name) for name in model.model_fields})
    expect(again == subject.algorithm, f"{subject.algorithm!r} from its JSON {text}, got {again!r}")


@law("picklable", "comes back equal from pickle, as workers get it")
def _picklable(subject: Subject) -> None:
    again = pickle.loads(pickle.dumps(subject.algorithm))
    expect(again == subject.algorithm, f"{subject.algorithm!r} from its pickle, got {again!r}")


@law("compiles", "compiles for the camera, bar and codebook of the link")
def _compiles(subject: Subject) -> None:
    try:
        compile_given(subject, arguments_of(subject))
    except ConfigError as refused:
        which = "the default" if subject.link is None else "the link's"
        raise LawError(f"expected {which} camera, bar and codebook to do, got: {refused}") from refused


@law("inputs-kept", "arrays that it is given stay as they were")
def _inputs_kept(subject: Subject) -> None:
    task = exercise_of(subject)
    given = map_arrays(task.inputs, np.copy)
    task.prepare()(*given)
    expect_same(given, task.inputs, "inputs to stay as they were", name="input")


def _expect_same_from(subject: Subject, change: Callable[[NDArray[Any]], NDArray[Any]], kind: str) -> None:
    task = exercise_of(subject)
    wanted = task.prepare()(*map_arrays(task.inputs, np.copy))
    got = task.prepare()(*map_arrays(task.inputs, change))
    expect_same(got, wanted, f"the same result from {kind}", _SAME)


@law("read-only", "takes read-only arrays")
def _accepts_read_only(subject: Subject) -> None:
    def locked(array: NDArray[Any]) -> NDArray[Any]:
        out = array.copy()
        out.setflags(write=False)
        return out

    _expect_same_from(subject, locked, "read-only arrays")


@law("non-contiguous", "takes arrays whose elements do not lie side by side")
def _accepts_strided(subject: Subject) -> None:
    def strided(array: NDArray[Any]) -> NDArray[Any]:
        return array.repeat(2, axis=-1)[..., ::2]

    _expect_same_from(subject, strided, "arrays that are not contiguous")


@law("deterministic", "equal inputs give equal results, without global random numbers")
def _deterministic(subject: Subject) -> None:
    task = exercise_of(subject)
    before = np.random.get_state()  # noqa: NPY002
    try:
        np.random.seed(1)  # noqa: NPY002
        run = task.prepare()
        first = map_arrays(run(*task.inputs), np.copy)
        np.random.seed(2)  # noqa: NPY002
        start = np.random.get_state()[1].tobytes()  # type: ignore[index]  # noqa: NPY002
        expect_same(run(*task.inputs), first, "the same result when called again")
        expect_same(task.prepare()(*task.inputs), first, "the same result when compiled again")
        end = np.random.get_state()[1].tobytes()  # type: ignore[index]  # noqa: NPY002
        expect(start == end, "NumPy's global random numbers to stay untouched: take a Generator")
    finally:
        np.random.set_state(before)  # noqa: NPY002


@law("results-owned", "what it returns is the caller's to change")
def _results_owned(subject: Subject) -> None:
    def clear(array: NDArray[Any]) -> NDArray[Any]:
        if array.flags.writeable:
            array[...] = 0
        return array

    task = exercise_of(subject)
    run = task.prepare()
    first = run(*task.inputs)
    wanted = map_arrays(first, np.copy)
    map_arrays(first, clear)
    expect_same(run(*task.inputs), wanted, "a result that is changed by the caller not to change the next")


DESCRIPTION = (_defaults, _frozen, _described, _round_trip, _picklable)
"""Laws of the description."""

FUNCTION = (_compiles, _inputs_kept, _accepts_read_only, _accepts_strided)
"""Laws of roles that take arrays."""

RESULT = (_deterministic, _results_owned)
"""Laws of what any role returns."""

"""Laws of form, the same for every role: a description with defaults, and pure functions over arrays."""

import dataclasses
import json
import pickle
from typing import Any, get_type_hints

import numpy as np
from pydantic.fields import FieldInfo

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.plugin.roles import ROLES
from evlcp_sdk.specs import spec_model
from evlcp_sdk.testing.exercises import arguments_of, exercise_of
from evlcp_sdk.testing.law import Law, LawError, Subject, expect
from evlcp_sdk.testing.trees import arrays_of, copied, difference, mapped, read_only, strided

__all__ = ["DESCRIPTION", "FUNCTION", "RESULT"]

_SAME = 1e-5
"""Tolerance where the order of a sum may change: single precision."""


def _parameters(subject: Subject) -> list[dataclasses.Field[Any]]:
    expect(dataclasses.is_dataclass(subject.algorithm), "a dataclass")
    return [f for f in dataclasses.fields(subject.algorithm) if f.init]


def defaults(subject: Subject) -> None:
    """Hold the law."""
    cls = type(subject.algorithm)
    abstract = ROLES[subject.role].abstract
    expect(isinstance(subject.algorithm, abstract), f"an instance of {abstract.__name__}")
    for f in _parameters(subject):
        bare = f.default is dataclasses.MISSING and f.default_factory is dataclasses.MISSING
        expect(not bare, f"a default of field {f.name!r}")
    expect(cls() == cls(), "two algorithms with all defaults to be equal")


def frozen(subject: Subject) -> None:
    """Hold the law."""
    _parameters(subject)
    expect(subject.algorithm.__dataclass_params__.frozen, "@dataclass(frozen=True)")
    expect(
        hash(subject.algorithm) == hash(dataclasses.replace(subject.algorithm)), "equal ones to hash equal"
    )


def described(subject: Subject) -> None:
    """Hold the law."""
    cls = type(subject.algorithm)
    own = cls.__dict__.get("__doc__") or ""
    expect(own.strip() and not own.startswith(f"{cls.__name__}("), f"a docstring of class {cls.__name__}")
    hints = get_type_hints(cls, include_extras=True)
    for f in _parameters(subject):
        notes = getattr(hints[f.name], "__metadata__", ())
        told = any(isinstance(n, FieldInfo) and n.description for n in notes)
        expect(told, f"field {f.name!r} as Annotated[..., Field(description=...)]")


def round_trip(subject: Subject) -> None:
    """Hold the law."""
    _parameters(subject)
    cls = type(subject.algorithm)
    model = spec_model(cls)
    text = json.dumps(dataclasses.asdict(subject.algorithm), allow_nan=False)
    values = model.model_validate_json(text)
    again = cls(**{name: getattr(values, name) for name in model.model_fields})
    expect(again == subject.algorithm, f"{subject.algorithm!r} from its JSON {text}, got {again!r}")


def picklable(subject: Subject) -> None:
    """Hold the law."""
    again = pickle.loads(pickle.dumps(subject.algorithm))
    expect(again == subject.algorithm, f"{subject.algorithm!r} from its pickle, got {again!r}")


def compiles(subject: Subject) -> None:
    """Hold the law."""
    try:
        subject.algorithm.compile(*arguments_of(subject))
    except ConfigError as refused:
        which = "the default" if subject.link is None else "the link's"
        raise LawError(f"expected {which} camera, bar and codebook to do, got: {refused}") from refused


def deterministic(subject: Subject) -> None:
    """Hold the law."""
    task = exercise_of(subject)
    before = np.random.get_state()  # noqa: NPY002
    try:
        np.random.seed(1)  # noqa: NPY002
        run = task.prepare()
        first = mapped(run(task.inputs), copied)
        np.random.seed(2)  # noqa: NPY002
        start = np.random.get_state()[1].tobytes()  # type: ignore[index]  # noqa: NPY002
        for again, what in ((run(task.inputs), "called"), (task.prepare()(task.inputs), "compiled")):
            differs = difference(again, first)
            expect(differs is None, f"the same result when {what} again; {differs}")
        end = np.random.get_state()[1].tobytes()  # type: ignore[index]  # noqa: NPY002
        expect(start == end, "NumPy's global random numbers to stay untouched: take a Generator")
    finally:
        np.random.set_state(before)  # noqa: NPY002


def inputs_kept(subject: Subject) -> None:
    """Hold the law."""
    task = exercise_of(subject)
    given = mapped(task.inputs, copied)
    task.prepare()(given)
    differs = difference(given, task.inputs, name="input")
    expect(differs is None, f"inputs to stay as they were; {differs}")


def accepts_read_only(subject: Subject) -> None:
    """Hold the law."""
    task = exercise_of(subject)
    wanted = task.prepare()(mapped(task.inputs, copied))
    differs = difference(task.prepare()(mapped(task.inputs, read_only)), wanted, _SAME)
    expect(differs is None, f"the same result from read-only arrays; {differs}")


def accepts_strided(subject: Subject) -> None:
    """Hold the law."""
    task = exercise_of(subject)
    wanted = task.prepare()(mapped(task.inputs, copied))
    differs = difference(task.prepare()(mapped(task.inputs, strided)), wanted, _SAME)
    expect(differs is None, f"the same result from arrays that are not contiguous; {differs}")


def results_owned(subject: Subject) -> None:
    """Hold the law."""
    task = exercise_of(subject)
    run = task.prepare()
    first = run(task.inputs)
    wanted = mapped(first, copied)
    for array in arrays_of(first):
        if array.flags.writeable:
            array[...] = 0
    differs = difference(run(task.inputs), wanted)
    expect(differs is None, f"a result that is changed by the caller not to change the next; {differs}")


DESCRIPTION = (
    Law("defaults", "every parameter has a default, and the class fills its role", defaults),
    Law("frozen", "a frozen, hashable dataclass", frozen),
    Law("described", "class and parameters say what they are", described),
    Law("round-trip", "parameters come back equal from JSON, as the configuration reads them", round_trip),
    Law("picklable", "comes back equal from pickle, as workers get it", picklable),
)
"""Laws of the description."""

FUNCTION = (
    Law("compiles", "compiles for the camera, bar and codebook of the link", compiles),
    Law("inputs-kept", "arrays that it is given stay as they were", inputs_kept),
    Law("read-only", "takes read-only arrays", accepts_read_only),
    Law("non-contiguous", "takes arrays whose elements do not lie side by side", accepts_strided),
)
"""Laws of roles that take arrays."""

RESULT = (
    Law("deterministic", "equal inputs give equal results, without global random numbers", deterministic),
    Law("results-owned", "what it returns is the caller's to change", results_owned),
)
"""Laws of what any role returns."""

"""Scenes, integrators, outputs and options that do not go together: typed errors, on all ranks."""

import shutil
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
import ufl
from dolfinx import fem
from fuzzing import (
    FEW,
    MANY,
    NO_NUMBERS,
    Odd,
    examples,
    failing,
    negative,
    no_numbers,
    not_positive,
    told,
    wild,
)
from hypothesis import given
from hypothesis import strategies as st

import complexbody as cb
from complexbody import _compat, meshes


def energy(U, nu, N):
    return ufl.inner(U, U) + ufl.inner(N, N) + ufl.inner(nu, nu)


BODY = cb.Body(1, energy, 1.0, 1.0, 0.1, displacement=2)


def only(values, *wrong):
    """Those of the values that are of none of the kinds."""
    return st.sampled_from([v for v in values if not isinstance(v, wrong)])


#: Predicates that are none.
bad_predicate = st.one_of(
    failing,
    st.sampled_from([
        lambda x: None, lambda x: x, lambda x: x[0], lambda x: x[:1] < 9, lambda x: np.ones(3),
        lambda x: True, lambda x: np.full(x.shape[1], "yes"), lambda x: np.full(x.shape[1], np.nan),
        lambda x: x[0] > 99, lambda x: x[7] < 1, lambda: None, lambda x, y: x[0] < 1,
        lambda x: [[True], [True, False]], lambda x: np.full(x.shape[1], None), lambda x: {},
        lambda x: np.zeros(x.shape[1], bool), lambda x: "no" * x.shape[1], int, str, Odd,
    ]),
)  # fmt: skip
bad_where = st.one_of(
    bad_predicate, only(NO_NUMBERS, type), wild,
    st.sampled_from([3, -1, [1, 99], [], "left", 1.5, [[1]], (None,), [np.nan], {1: 2}, 2**70]),
)  # fmt: skip
#: Values of two components that are none.
bad_values = st.one_of(
    wild, failing, only(NO_NUMBERS, bool, np.bool_, type, type(None)),
    st.sampled_from([
        (1.0, 2.0, 3.0), (1.0, np.nan), (1.0, None), ("1", "2"), [1j, 0], (1.0, np.inf), object,
        lambda x: x, lambda x: x[:1] * np.nan, lambda x: "x", lambda x: x[0, :2], lambda x: x[:0],
        lambda x: 1j * x[:2], lambda x, t: x[:2], lambda: 1.0, lambda x: [x[0]], lambda x: 1 / 0,
        lambda x: np.full((2, x.shape[1]), 10**400), lambda x: np.full((2, x.shape[1]), "1"),
    ]),
).filter(lambda v: getattr(v, "__name__", "") != "sneak")  # fmt: skip
bad_components = st.sampled_from([
    [5], [-1], "x", 1.5, [], [[0]], [[0, 1]], np.nan, [0, 9], [0.5], [None], {}, Odd(), b"0", 2**70,
    "0", True, [True], 1j, (0, 0, 0),
])  # fmt: skip
bad_history = st.one_of(
    failing,
    st.sampled_from([
        None, 3, "ricker", [], Odd(), lambda t: np.nan * t, lambda t: np.ones(3), lambda t: None,
        lambda: 1.0, lambda t, x: 1.0, lambda t: "a", lambda t: 1j * np.ones_like(t), lambda t: [],
        lambda t: np.inf, lambda t: 1 / 0, lambda t: {}, lambda t: np.ones((1, np.size(t))),
        lambda t: np.where(t > 2e-4, np.nan, 1.0), lambda t: 10**400, cb.ricker, str,
    ]),
)  # fmt: skip
bad_field = st.sampled_from(["", "v", "U", None, 3, [], ["u"], ("u", "nu"), b"u", Odd(), np.nan])
bad_number = st.one_of(no_numbers, wild)


@dataclass(frozen=True)
class Made:
    """Calls ``make`` when called, and shows what is bad about it."""

    make: Any
    good: dict
    bad: dict
    listed: bool = False

    def __call__(self):
        """What ``make`` makes."""
        made = self.make(**self.good | self.bad)
        return [made] if self.listed else made

    def __repr__(self):
        shown = (f"{name}={_shown(value)}" for name, value in self.bad.items())
        return f"{self.make.__name__}({', '.join(shown)})"


def _shown(value):
    """A function by where it is written."""
    if not hasattr(value, "__code__"):
        return repr(value)
    line, _, column, _ = list(value.__code__.co_positions())[-1]
    return f"<function of {value.__module__}, line {line}, column {column}>"


@st.composite
def one_wrong(draw, make, good, bad):
    """``make`` of good arguments of which one or two are bad."""
    names = draw(st.lists(st.sampled_from(sorted(bad)), min_size=1, max_size=2, unique=True))
    return Made(make, good, {name: draw(bad[name]) for name in names})


fixes = one_wrong(
    cb.Fix, {"field": "u", "where": lambda x: x[0] < 1e-9, "value": 0.0},
    {"field": bad_field, "where": bad_where, "value": bad_values, "components": bad_components,
     "history": bad_history},
)  # fmt: skip
tractions = one_wrong(
    cb.Traction, {"where": lambda x: x[0] < 1e-9, "vector": (1.0, 0.0)},
    {"where": bad_where, "vector": bad_values | st.just(1.0), "history": bad_history,
     "field": bad_field},
)  # fmt: skip
pressures = one_wrong(
    cb.Pressure, {"where": "boundary", "pressure": 1.0},
    {"where": bad_where, "pressure": bad_number | failing, "history": bad_history},
)  # fmt: skip
forces = one_wrong(
    cb.BodyForce, {"vector": (1.0, 0.0)},
    {"where": bad_where.filter(lambda w: w is not None), "vector": bad_values | st.just(1.0),
     "history": bad_history, "field": bad_field},
)  # fmt: skip
initials = one_wrong(
    cb.Initial, {}, {"u": bad_values, "u_dot": bad_values, "nu": bad_values, "nu_dot": bad_values}
)
sources = one_wrong(
    cb.PointSource, {"at": (0.5, 0.5), "vector": (1.0, 0.0)},
    {"at": bad_values | st.sampled_from([1.0, (9.0, 9.0), (0.5, 0.5, 0.5)]),
     "vector": bad_values | st.just(1.0), "history": bad_history, "field": bad_field,
     "moment": bad_values | st.sampled_from([1.0, [[1.0]], [[[1.0]]], [[1.0], [np.nan]]])},
)  # fmt: skip
mirrors = one_wrong(
    cb.Symmetry, {"where": lambda x: x[0] < 1e-9, "parity": "even"},
    {"where": bad_where, "parity": st.sampled_from(["", "polarised", 3, [2.0], ["1"], Odd(), 1j]),
     "normal": st.sampled_from([(0.0, 1.0), (1.0, 1.0), "x", (np.nan, 0.0), 1.0, (0.0, 0.0)]),
     "u": st.sampled_from(["oddly", [[1.0]], Odd(), np.eye(3), np.nan])},
)  # fmt: skip
dampers = one_wrong(
    cb.Absorb, {"where": lambda x: x[0] < 1e-9},
    {"where": bad_where, "frequency": no_numbers.filter(lambda v: v is not None) | wild | negative,
     "field": bad_field.filter(lambda v: v is not None)},
)  # fmt: skip
repeats = st.one_of(
    st.sampled_from([2, -1, "x", (0, 0), 0.5, True, [None], {0: 1}, Odd(), 2**70]).map(
        lambda v: lambda: v),
    one_wrong(
        cb.Periodic, {"where": lambda x: x[0] < 1e-9, "vector": (1.0, 0.0)},
        {"where": bad_where, "vector": bad_values | st.sampled_from(
            [1.0, (0.0, 0.0), (0.5, 0.0), (2.0, 0.0), (1.0, 0.0, 0.0)])},
    ),
)  # fmt: skip
junk = st.sampled_from([x for x in NO_NUMBERS if not isinstance(x, type) and x is not None])
nothing = [[], (), {}, ""]
parts = st.one_of(
    st.tuples(st.just("supports"), mirrors.map(lambda made: replace(made, listed=True))),
    st.tuples(st.just("absorbing"), dampers.map(lambda made: replace(made, listed=True))),
    st.tuples(st.just("periodic"), repeats),
    st.tuples(st.just("supports"), fixes.map(lambda made: replace(made, listed=True))),
    st.tuples(st.just("loads"), st.one_of(tractions, pressures, forces, sources).map(
        lambda made: replace(made, listed=True))),
    st.tuples(st.just("initial"), initials),
    st.tuples(
        st.sampled_from(["supports", "loads"]),
        st.sampled_from([None, 3, "abc", [None], [3], Odd(), [[cb.Fix("u", "boundary")]],
                         cb.Initial(), BODY, cb.Fix]).map(lambda v: lambda: v),
    ),
    st.tuples(st.sampled_from(["body", "mesh", "cell_tags", "facet_tags", "self_action", "name"]),
              junk.map(lambda v: lambda: v)),
    st.tuples(st.just("body"), st.sampled_from(
        [None, {}, {1: 2}, {1: BODY}, [BODY], {None: BODY}, {"a": BODY, 1: BODY}, cb.Body]
    ).map(lambda v: lambda: v)),
    st.tuples(st.just("supports"), st.sampled_from([(0.0, 1.0), (1.0, 1.0 + 1e-6)]).map(
        lambda v: lambda: [cb.Fix("u", "boundary", value=v[0]), cb.Fix("u", "boundary", v[1])])),
)  # fmt: skip


def unharmful(part):
    """Whether a part may be taken after all."""
    name, value = part
    made = value() if name in ("cell_tags", "facet_tags", "self_action", "name") else 0
    return name == "name" and isinstance(made, str)


@st.composite
def bad_scenes(draw):
    """One or two wrong parts."""
    return dict(draw(st.lists(parts.filter(lambda p: not unharmful(p)), min_size=1, max_size=2)))


@pytest.mark.parametrize("count", [FEW, pytest.param(2 * MANY, marks=pytest.mark.slow)])
def test_bad_scenes_are_refused_on_all_ranks(comm, count):
    mesh, kinds = meshes.rectangle(comm, (0, 0), (1, 1), (3, 3)), []

    @examples(count)
    @given(bad_scenes())
    def one(wrong):
        def case():
            scene = cb.Scene(**{"mesh": mesh, "body": BODY} | {k: f() for k, f in wrong.items()})
            cb.simulate(scene, until=4e-4)

        kinds.append(told(case))

    one()
    assert len(kinds) >= count


# --- integrators and options ---------------------------------------------------------------------

bad_step = st.one_of(no_numbers.filter(lambda v: v is not None), wild, not_positive)
bad_choice = st.one_of(
    no_numbers.filter(lambda v: v is not None), st.sampled_from(["", "x", "EXACT", 3, 2.5, -1])
)
bad_flag = st.sampled_from(["yes", 2, 1.5, [], {}, Odd(), np.nan])
OPTIONS = {
    cb.Synchronous: {"step": bad_step, "safety": bad_step | st.none(), "dissipation": bad_choice,
                     "start": bad_choice, "critical": bad_choice, "unstable_ok": bad_flag},
    cb.AVI: {"safety": bad_step | st.none(), "schedule": bad_choice, "dissipation": bad_choice,
             "start": bad_choice, "balanced": bad_flag, "corrected": bad_flag,
             "unstable_ok": bad_flag},
    cb.LocalLeapfrog: {"safety": bad_step | st.none(), "dissipation": bad_choice,
                       "stabilisation": negative | no_numbers | wild, "step": bad_step,
                       "levels": st.one_of(no_numbers.filter(lambda v: v is not None), wild,
                                           negative, st.sampled_from([1.5, 10**6]))},
    cb.Implicit: {"step": bad_step, "order": bad_choice, "quadrature": bad_choice,
                  "solve": bad_choice, "tolerance": bad_step | st.none(), "forces": bad_choice,
                  "iterations": bad_step | st.none(), "monitor": bad_flag,
                  "options": st.sampled_from([3, "a", [1], None, {1: 2}])},
    cb.AssembledLeapfrog: {"force": bad_choice, "step": bad_step, "safety": bad_step | st.none(),
                           "dissipation": bad_choice, "unstable_ok": bad_flag},
    cb.Newmark: {"step": bad_step, "beta": no_numbers | wild | negative,
                 "gamma": no_numbers | wild | negative, "tolerance": bad_step | st.none()},
    cb.PetscTS: {"kind": bad_choice, "step": bad_step, "tolerance": bad_step | st.none()},
}  # fmt: skip


@st.composite
def bad_integrators(draw):
    """An integrator with one or two wrong options, or none at all."""
    kind = draw(st.sampled_from([*OPTIONS, None]))
    if kind is None:
        wrong = draw(st.sampled_from(["avi", cb.AVI, cb.Synchronous, 3, [], Odd(), BODY, 1.5]))
        return lambda: wrong
    good = {} if kind in (cb.Synchronous, cb.AVI, cb.LocalLeapfrog) else {"step": 1e-4}
    return draw(one_wrong(kind, good, OPTIONS[kind]))


bad_until = st.one_of(no_numbers, wild, not_positive)
bad_steps = st.one_of(
    no_numbers.filter(lambda v: v is not None), wild, negative, st.sampled_from([0, 1.5, 2.0])
)
BAD_OPTIONS = {
    "until": bad_until,
    "ledger_steps": bad_steps,
    "growth": st.one_of(no_numbers.filter(lambda v: v is not None), wild, not_positive),
    "accuracy": st.one_of(no_numbers.filter(lambda v: v is not None), wild, not_positive),
    "output": st.sampled_from([3, "results", [], Odd(), True, cb.Output]),
    "progress": bad_flag, "plan": bad_flag, "quiet": bad_flag,
}  # fmt: skip


@pytest.mark.parametrize("count", [FEW, pytest.param(MANY, marks=pytest.mark.slow)])
def test_bad_integrators_and_options_are_refused_on_all_ranks(comm, count):
    mesh, kinds = meshes.rectangle(comm, (0, 0), (1, 1), (3, 3)), []
    scene = cb.Scene(mesh, BODY, initial=cb.Initial(u=lambda x: x[:2]))

    @examples(count)
    @given(st.one_of(
        bad_integrators().map(lambda make: {"integrator": make}),
        one_wrong(dict, {}, BAD_OPTIONS).map(lambda make: make()),
    ))  # fmt: skip
    def one(wrong):
        def case():
            options = {"until": 4e-4, **wrong}
            if "integrator" in options:
                options["integrator"] = options["integrator"]()
            cb.simulate(scene, **options)

        kinds.append(told(case))

    one()
    assert len(kinds) >= count


OUTPUTS = {
    "every": bad_step,
    "times": st.sampled_from(["x", [-1.0], [np.nan], [None], {1: 2}, 1j, [[0], [1, 2]], Odd(),
                              ["1"], [10**400], -1.0]),
    "fields": st.sampled_from(["v", ["u", "w"], [3], [None], 3, None, [[]], Odd(), {"x": 1}]),
    "probes": st.sampled_from([3, "a", [1], None, {"a": "b"}, {"a": (np.nan, 0.0)}, {3: (0.5, 0.5)},
                               {"a/b": (0.5, 0.5)}, {"": (0.5, 0.5)}, {"a": ()}, {"a": (9.0, 9.0)},
                               {"a": (0.5,)}, {"a": None}, {"a": (1j, 0)},
                               {"a": (0.5, 0.5, 0.5)}, {"a": 10**400}, {"a\0": (0.5, 0.5)}]),
    "probe_steps": st.one_of(no_numbers, wild, not_positive, st.sampled_from([1.5, 2.0])),
    "folder": st.sampled_from([None, 3, [], b"x", "/proc/x", "/dev/null/x", "a\0b", Odd(), 1.5]),
}  # fmt: skip
HISTORIES = [
    (cb.ricker, {"frequency": bad_step | st.none(), "delay": no_numbers.filter(
        lambda v: v is not None) | wild}),
    (cb.ramp, {"duration": bad_step | st.none(), "start": no_numbers | wild}),
    (cb.step, {"start": no_numbers, "end": no_numbers}),
    (cb.sine, {"frequency": bad_step | st.none(), "phase": no_numbers | wild}),
    (cb.table, {"times": no_numbers | st.sampled_from([[1, 0], [0, 0], [np.nan, 1], [0, 1, 2]]),
                "values": no_numbers | st.sampled_from([[np.nan, 0], [0], ["a", "b"], [1j, 0]])}),
]  # fmt: skip
GOODS = {
    "ricker": {"frequency": 1.0}, "ramp": {"duration": 1.0}, "step": {}, "sine": {"frequency": 1.0},
    "table": {"times": [0.0, 1.0], "values": [0.0, 1.0]},
}  # fmt: skip


@pytest.mark.parametrize("count", [FEW, pytest.param(MANY, marks=pytest.mark.slow)])
def test_bad_outputs_and_histories_are_refused_on_all_ranks(comm, shared_path, count):
    mesh, kinds = meshes.rectangle(comm, (0, 0), (1, 1), (3, 3)), []
    scene = cb.Scene(mesh, BODY, initial=cb.Initial(u=lambda x: x[:2]))
    folder = shared_path / "out"
    made = [one_wrong(cb.Output, {"folder": folder}, OUTPUTS).map(lambda make: ("output", make))]
    made += [
        one_wrong(make, GOODS[make.__name__], bad).map(lambda make: ("history", make))
        for make, bad in HISTORIES
    ]

    @examples(count)
    @given(st.one_of(*made))
    def one(wrong):
        what, make = wrong

        def case():
            if what == "history":
                make()
            else:
                cb.simulate(scene, until=4e-4, output=make())

        kinds.append(told(case))
        left = [path.name for path in folder.iterdir()] if folder.exists() else []
        comm.barrier()
        if comm.rank == 0:
            shutil.rmtree(folder, ignore_errors=True)  # what is left is this case's
        comm.barrier()
        assert not left

    one()
    assert len(kinds) >= count


def test_fields_of_other_meshes_are_refused_on_all_ranks(comm):
    """Functions of another mesh, space or number of components as initial data."""
    mesh = meshes.rectangle(comm, (0, 0), (1, 1), (3, 3))
    other = meshes.rectangle(comm, (0, 0), (1, 1), (5, 4))
    for function in (
        fem.Function(_compat.vector_space(other, 2)),
        fem.Function(_compat.vector_space(mesh, 3)),
        fem.Function(_compat.cell_space(mesh)),
    ):
        for name in ("u", "nu_dot"):
            told(lambda f=function, n=name: cb.simulate(
                cb.Scene(mesh, BODY, initial=cb.Initial(**{n: f})), until=4e-4))  # fmt: skip

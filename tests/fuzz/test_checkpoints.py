"""Checkpoints that are damaged, foreign or made up: refused by name, or as good as the real one."""

import copy
import json
import zipfile

import numpy as np
import pytest
from busy import busy
from fuzzing import FEW, MANY, NO_NUMBERS, Odd, examples, negative, no_numbers, told, wild
from hypothesis import given
from hypothesis import strategies as st

import complexbody as cb
from complexbody import statefile

UNTIL = 1.0
junk = st.one_of(
    st.none(), st.booleans(), st.integers(-3, 2**70), st.floats(), st.text(max_size=5),
    st.lists(st.floats(), max_size=3),
    st.dictionaries(st.text(max_size=3), st.floats(), max_size=2),
)  # fmt: skip


@pytest.fixture(scope="module")
def case(comm, tmp_path_factory):
    """A scene, its integrator, where rank 0 has checkpoints of it, the end state."""
    folder = comm.bcast(tmp_path_factory.mktemp("checkpoints") if comm.rank == 0 else None)
    scene, method = busy(comm, 2, "numbers"), cb.AVI()
    keep = cb.Checkpoint(None, 5, keep=9, folder=folder)
    end = cb.simulate(scene, method, until=UNTIL, checkpoint=keep)
    comm.barrier()
    return scene, method, folder, end


def going_on(comm, case, path):
    """Resume from a file; the end is what it is, to the bit."""
    scene, method, _, end = case

    def resumed():
        result = cb.simulate(scene, method, until=UNTIL, resume=path)
        for name in ("u", "nu", "u_dot", "nu_dot"):
            values = getattr(result, name).x.array
            assert np.array_equal(values, getattr(end, name).x.array), f"another {name}"

    return resumed


def first(comm, folder):
    """The oldest checkpoint, of which there is most to go on."""
    return comm.bcast(statefile.listed(folder)[-1] if comm.rank == 0 else None)


@st.composite
def damage(draw):
    """A change of bytes, as a function of all of them."""
    kind = draw(st.sampled_from(["flip", "cut", "add", "swap", "zero", "other"]))
    at, size = draw(st.floats(0, 1, exclude_max=True)), draw(st.integers(1, 64))
    data = draw(st.binary(min_size=1, max_size=size))

    def changed(whole):
        place = int(at * len(whole))
        end = place + size
        out = {
            "flip": whole[:place] + bytes([whole[place] ^ (1 + size % 255)]) + whole[place + 1 :],
            "cut": whole[:place], "add": whole[:place] + data + whole[place:],
            "swap": whole[place:] + whole[:place], "other": data * size,
            "zero": whole[:place] + bytes(len(whole[place:end])) + whole[end:],
        }[kind]  # fmt: skip
        return out if out != whole else whole[:-1]

    return changed


@pytest.mark.parametrize("count", [FEW, pytest.param(MANY, marks=pytest.mark.slow)])
def test_damaged_files(comm, case, shared_path, count):
    """No change of bytes is taken for a checkpoint."""
    whole, kinds = first(comm, case[2]).read_bytes(), []

    @examples(count)
    @given(damage())
    def one(change):
        path = shared_path / "step-000000000005.npz"
        if comm.rank == 0:
            path.write_bytes(change(whole))
        comm.barrier()
        kinds.append(told(going_on(comm, case, path)))

    one()
    assert len(kinds) >= count and set(kinds) == {"CheckpointError"}


def places(value, path=()):
    """Paths of all parts of a description."""
    yield path
    if not isinstance(value, dict | list):
        return
    for key, part in value.items() if isinstance(value, dict) else enumerate(value):
        yield from places(part, (*path, key))


forgeries = st.one_of(
    st.tuples(
        st.just("array"), st.integers(0, 99),
        st.sampled_from(["gone", "shape", "rows", "nan", "text", "dates", "flat"]),
    ),
    st.tuples(st.just("gone"), st.integers(0, 999), st.none()),
    st.tuples(st.just("other"), st.integers(0, 999), junk),
)  # fmt: skip


def forged(about, arrays, change):
    """A description and arrays of which one is gone or another."""
    about, arrays = copy.deepcopy(about), dict(arrays)
    what, which, how = change
    if what == "array":
        names = sorted(arrays)
        name = names[which % len(names)]
        array = arrays.pop(name)
        if how != "gone":
            bad = array.astype(float)
            bad.flat[:1] = np.nan
            arrays[name] = {
                "shape": array[..., None], "rows": np.concatenate([array, array[:1]]), "nan": bad,
                "text": array.astype("U8"), "dates": array.astype("M8[s]"), "flat": array.ravel(),
            }[how]  # fmt: skip
        return about, arrays
    paths = [path for path in places(about) if path]
    *path, last = paths[which % len(paths)]
    part = about
    for key in path:
        part = part[key]
    if what == "gone":
        del part[last]
    else:
        part[last] = how
    return about, arrays


@pytest.mark.parametrize("count", [FEW, pytest.param(MANY, marks=pytest.mark.slow)])
def test_forged_files(comm, case, shared_path, count):
    """With a checksum that is right: typed errors alone, or a run that ends."""
    scene, method, folder, _ = case
    about, arrays = statefile.read(first(comm, folder))
    del about["format"]
    arrays = {name: arrays[name] for name in arrays}
    kinds = []

    @examples(count)
    @given(forgeries)
    def one(change):
        said, tables = forged(about, arrays, change)
        path = shared_path / "step-000000000005.npz"
        if comm.rank == 0:
            statefile.write(path, said, iter(tables.items()))
        comm.barrier()
        resume = lambda: cb.simulate(scene, method, until=UNTIL, resume=path)  # noqa: E731
        # What is said of versions or times of the clock, and books' rows, may be anything.
        other = [name for name in arrays if arrays[name] is not tables.get(name)]
        kinds.append(told(resume, bad=bool(other) and other != ["ledger"]))

    one()
    assert len(kinds) >= count


def test_no_archive_with_a_good_checksum(comm, case, shared_path):
    """Bytes that are no archive, an archive without a description, one that is no JSON object."""
    path = shared_path / "step-000000000005.npz"

    def sealed(text):
        if comm.rank == 0:
            with zipfile.ZipFile(path, "w") as archive:
                archive.writestr("x", b"x")
                if text is not None:
                    archive.writestr("about.json", text)
                archive.comment = b"0" * 64
            body = path.read_bytes()[:-64]
            path.write_bytes(body)
            with path.open("rb") as file:
                digest = statefile._digest(file, len(body))
            path.write_bytes(body + digest.encode())
        comm.barrier()
        return path

    forged = [{"format": statefile.FORMAT}, {"format": 1}, {"format": None, "versions": 3}]
    for text in (None, "", "[]", "3", "{", *map(json.dumps, forged)):
        told(going_on(comm, case, sealed(text)))


@pytest.mark.parametrize("count", [FEW, pytest.param(MANY, marks=pytest.mark.slow)])
def test_bad_wishes(comm, case, shared_path, count):
    """Checkpoint's arguments, and what to resume from."""
    scene, method, folder, _ = case
    number = st.one_of(no_numbers, wild, negative, st.just(0))
    bad = {
        "every": number.filter(lambda v: v is not None), "keep": number | st.just(1.5),
        "steps": number.filter(lambda v: v is not None) | st.just(1.5),
        "folder": st.sampled_from([3, [], b"x", "", "a\0b", Odd(), 1.5, "/proc/x", "/dev/null/x"]),
    }  # fmt: skip
    resumes = [v for v in NO_NUMBERS if not isinstance(v, str | bool | np.bool_)]
    resumes += [3, "nowhere", "/dev/null", "a\0b", str(shared_path), Odd(), b"x", ""]

    @examples(count)
    @given(
        st.one_of(
            st.sampled_from(sorted(bad)).flatmap(lambda n: bad[n].map(lambda v: {n: v})),
            st.sampled_from(resumes).map(lambda v: {"resume": v}),
        )
    )
    def one(wrong):
        def wish():
            if "resume" in wrong:
                cb.simulate(scene, method, until=UNTIL, resume=wrong["resume"])
            else:
                keep = cb.Checkpoint(**{"steps": 5, "folder": folder} | wrong)
                cb.simulate(scene, method, until=UNTIL, checkpoint=keep)

        told(wish)

    one()

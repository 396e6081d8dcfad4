"""The restricted unpickler reads arrays in containers, and runs nothing."""

import os
import pickle
from collections import OrderedDict
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra.numpy import arrays

from lerobot_agpd.envs.array_pickle import load_arrays

ARRAYS = arrays(
    st.sampled_from([np.float64, np.float32, np.int64, np.bool_]), st.sampled_from([(), (3,), (2, 0), (2, 3)])
)
LEAVES = (
    ARRAYS | st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text() | st.binary()
)
TREES = st.recursive(
    LEAVES, lambda tree: st.lists(tree) | st.dictionaries(st.text(), tree) | st.tuples(tree), max_leaves=8
)


def assert_same(left, right):
    assert type(left) is type(right)
    if isinstance(left, np.ndarray):
        assert left.dtype == right.dtype
        np.testing.assert_array_equal(left, right)
    elif isinstance(left, dict):
        assert left.keys() == right.keys()
        for key in left:
            assert_same(left[key], right[key])
    elif isinstance(left, list | tuple):
        assert len(left) == len(right)
        for one, other in zip(left, right, strict=True):
            assert_same(one, other)
    else:
        assert left == right


@settings(max_examples=30, deadline=None)
@given(tree=TREES, protocol=st.sampled_from([3, 4]))
def test_arrays_in_containers_come_back(tmp_path_factory, tree, protocol):
    path = tmp_path_factory.mktemp("pickles") / "tree.pickle"
    path.write_bytes(pickle.dumps(tree, protocol))
    assert_same(load_arrays(path), tree)


def test_arrays_of_old_numpy_come_back(tmp_path):
    """Before numpy 2 the module was numpy.core, as in DAPG's files."""
    path = tmp_path / "old.pickle"
    written = pickle.dumps(np.arange(3.0), 3)
    assert b"numpy._core.multiarray" in written
    path.write_bytes(written.replace(b"numpy._core.multiarray", b"numpy.core.multiarray"))
    np.testing.assert_array_equal(load_arrays(path), [0, 1, 2])


class Calls:
    """Pickles as a call of a function."""

    def __init__(self, function, *args):
        self.call = function, args

    def __reduce__(self):
        return self.call


@pytest.mark.parametrize("protocol", [0, 1, 2, 3, 4, 5])
@pytest.mark.parametrize(
    ("function", "name"),
    [(os.system, "system"), (eval, "eval"), (exec, "exec"), (getattr, "getattr"), (open, "open")],
)
def test_functions_are_refused_by_name_and_not_run(tmp_path, protocol, function, name):
    ran = tmp_path / "ran"
    args = {
        "system": (f"touch {ran}",),
        "eval": (f"open({str(ran)!r}, 'w')",),
        "exec": (f"open({str(ran)!r}, 'w')",),
        "getattr": (np.ndarray, "tofile"),
        "open": (str(ran), "w"),
    }[name]
    path = tmp_path / "evil.pickle"
    path.write_bytes(pickle.dumps([{"rewards": Calls(function, *args)}], protocol))
    with pytest.raises(ValueError, match=rf"evil\.pickle is no pickle of numpy arrays: it names \w+\.{name}"):
        load_arrays(path)
    assert not ran.exists()


@pytest.mark.parametrize(
    ("value", "name"),
    [
        (OrderedDict(a=1), "collections.OrderedDict"),
        (Path("x"), "pathlib"),
        (np.random.default_rng(0), "numpy.random"),
        (np.float64(1), "multiarray.scalar"),
    ],
)
def test_objects_are_refused_by_name(tmp_path, value, name):
    path = tmp_path / "object.pickle"
    path.write_bytes(pickle.dumps([value], 4))
    with pytest.raises(ValueError, match=f"it names {name}|it names numpy._core.{name}"):
        load_arrays(path)


def test_parts_of_admitted_names_are_refused(tmp_path):
    """Protocol 4 may ask for `ndarray.tofile` of the module numpy."""
    path = tmp_path / "dotted.pickle"
    path.write_bytes(b"\x80\x04\x8c\x05numpy\x8c\x0endarray.tofile\x93.")
    with pytest.raises(ValueError, match=r"it names numpy\.ndarray\.tofile"):
        load_arrays(path)


@pytest.mark.parametrize(
    "content", [b"", b"not a pickle", pickle.dumps([np.zeros(9)], 4)[:-30], b"\x80\x04P0\n."]
)
def test_damaged_files_are_refused(tmp_path, content):
    path = tmp_path / "damaged.pickle"
    path.write_bytes(content)
    with pytest.raises(ValueError, match="damaged.pickle is no pickle of numpy arrays"):
        load_arrays(path)


def test_references_to_outside_are_refused(tmp_path):
    path = tmp_path / "persistent.pickle"
    path.write_bytes(b"\x80\x04\x8c\x04file\x51.")
    with pytest.raises(ValueError, match="refers to an object outside of the file, 'file'"):
        load_arrays(path)

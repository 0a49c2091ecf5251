# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests that hostile and damaged pickles raise named errors, and that arrays of every kind are read."""

import collections
import copyreg
import os
import pathlib
import pickle
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from torchrl_koap.data.d3il.unpickling import UnsafePickleError, load_pickle, loads_pickle
from torchrl_koap.files import DataError

PROTOCOLS = range(pickle.HIGHEST_PROTOCOL + 1)


class Call:
    def __init__(self, function, *args):
        self.value = (function, args)

    def __reduce__(self):
        return self.value


class Plain:
    pass


def assert_same(left, right):
    assert type(left) is type(right)
    if isinstance(left, dict):
        assert list(left) == list(right)
        for key in left:
            assert_same(left[key], right[key])
    elif isinstance(left, (list, tuple)):
        assert len(left) == len(right)
        for one, other in zip(left, right, strict=True):
            assert_same(one, other)
    elif isinstance(left, np.ndarray):
        assert left.dtype == right.dtype and left.shape == right.shape
        assert left.tobytes() == right.tobytes()
    else:
        assert left == right


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_plain_data_survive(protocol):
    value = {
        "context": None,
        "robot": {
            "c_pos": np.linspace(0, 1, 12).reshape(4, 3),
            "columns": np.asfortranarray(np.arange(6).reshape(2, 3)),
            "big": np.arange(4, dtype=">f4"),
            "empty": np.zeros((0, 3), dtype=np.float32),
            "flag": np.array([True, False]),
            "text": np.array(["rgb", "brg"]),
            "none_dim": np.array(3.0),
        },
        "scalars": [np.float64(1.5), np.int32(-4), np.bool_(True), 7, 2.5, True, b"", b"\xff\x00", "ü", 10**40, -1],
        "nested": ((), [], {}, ("a", (1, [2]))),
    }
    assert_same(loads_pickle(pickle.dumps(value, protocol)), value)


def test_ordered_dict_becomes_a_dict():
    value = collections.OrderedDict(b=1, a=np.ones(2))
    loaded = loads_pickle(pickle.dumps(value))
    assert type(loaded) is dict and list(loaded) == ["b", "a"]


@settings(max_examples=60, deadline=None)
@given(
    hnp.arrays(
        st.one_of(hnp.floating_dtypes(sizes=(16, 32, 64)), hnp.integer_dtypes(), hnp.boolean_dtypes()),
        hnp.array_shapes(min_dims=0, min_side=0, max_side=4),
    ),
    st.sampled_from(list(PROTOCOLS)),
)
def test_any_array_survives(array, protocol):
    shared = [array, {"again": array}]
    assert_same(loads_pickle(pickle.dumps(shared, protocol)), shared)


def test_names_of_numpy_1_and_2():
    new = pickle.dumps(np.arange(3.0), 2)
    assert b"numpy._core.multiarray" in new or b"numpy.core.multiarray" in new
    for module in (b"numpy.core.multiarray", b"numpy._core.multiarray"):
        content = new.replace(b"numpy._core.multiarray", b"numpy.core.multiarray").replace(
            b"numpy.core.multiarray", module
        )
        np.testing.assert_array_equal(loads_pickle(content), [0, 1, 2])


def hostile():
    """What is pickled, and what a refusal names; those that do anything leave a file ``executed`` behind."""
    objects = np.empty(1, dtype=object)
    objects[0] = Call(os.system, "touch executed")
    return {
        "system": (Call(os.system, "touch executed"), f"{os.name}.system"),
        "eval": (Call(eval, "open('executed', 'w')"), "builtins.eval"),
        "exec": (Call(exec, "open('executed', 'w')"), "builtins.exec"),
        "getattr": (Call(getattr, "x", "upper"), "builtins.getattr"),
        "open": (Call(open, "executed", "w"), "io.open"),
        "numpy.load": (Call(np.load, "executed"), "numpy.load"),
        "runstring": (Call(np.testing._private.utils.runstring, "open('executed', 'w')", {}), "runstring"),
        "class": (Plain(), "Plain"),
        "path": (pathlib.PurePosixPath("/x"), "pathlib"),
        "nested": ({"robot": {"c_pos": [np.zeros(2), (Call(os.system, "touch executed"),)]}}, f"{os.name}.system"),
        "object array": (objects, f"{os.name}.system|O8"),
        "datetime": (np.array(["2020-01-01"], dtype="M8[D]"), "M8"),
        "record": (np.zeros(2, dtype=[("x", "f8")]), "V8"),
        "array subclass": (np.ma.masked_array([1.0], [True]), "numpy.ma"),
    }


@pytest.mark.parametrize("protocol", PROTOCOLS)
@pytest.mark.parametrize("case", hostile())
def test_hostile_files_are_refused_by_name_and_not_run(case, protocol, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    value, name = hostile()[case]
    path = tmp_path / "demo_7.pkl"
    path.write_bytes(pickle.dumps(value, protocol))
    with pytest.raises(UnsafePickleError) as error:
        load_pickle(path)
    assert any(part in str(error.value) for part in name.split("|")) and "demo_7.pkl" in str(error.value)
    assert list(tmp_path.iterdir()) == [path]


def test_extension_codes_are_refused():
    copyreg.add_extension("builtins", "print", 0x7F)
    try:
        content = pickle.dumps(print, 2)
        pickle.loads(content)  # fills the cache that bypasses find_class
        with pytest.raises(UnsafePickleError, match="EXT1"):
            loads_pickle(content)
    finally:
        copyreg.remove_extension("builtins", "print", 0x7F)


def array_of(shape: bytes, state: bytes = b"U\x08\x00\x00\x00\x00\x00\x00\x00\x00") -> bytes:
    return (
        b"\x80\x02cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85U\x01b\x87R"
        b"(K\x01" + shape + b"cnumpy\ndtype\nU\x02f8\x89\x88\x87R\x89" + state + b"tb."
    )


@pytest.mark.parametrize(
    ("content", "message"),
    [
        *((pickle.dumps({1, 2}, protocol), "(?i)set") for protocol in PROTOCOLS),
        (pickle.dumps(np.array([None, "x"], dtype=object)), "element type 'O8'"),
        (array_of(b"K\x01\x85", b"]K\x01a"), "objects"),  # a permitted element type, and a list of objects
        (b"\x80\x02cnumpy.f2py.diagnose\nrun\n)R.", r"numpy\.f2py\.diagnose\.run"),  # not even imported
        (b"\x80\x04\x8c\x05numpy\x8c\x10ndarray.__init__\x93.", r"numpy\.ndarray\.__init__"),
        (b"\x80\x04\x8c\x02os\x94\x8c\x06system\x940h\x00h\x01\x93.", r"instruction POP \(after os system\)"),
        (b"\x80\x04\x8c\x02os\x94\x8c\x06system\x94\x86h\x00h\x01\x93.", r"os\.system"),  # remembered names
        (b"\x80\x04]\x8c\x06system\x93.", "STACK_GLOBAL requires str"),
        (b"Pid\n.", "PERSID"),
        (b"\x80\x04\x8c\x02id\x51.", "PERSID"),
        # tricks with permitted names
        (b"\x80\x02cnumpy\nndarray\n}U\x01xK\x01sb.", ""),  # attributes of the class through BUILD
        (b"\x80\x02cnumpy.core.multiarray\n_reconstruct\n}U\x08__code__K\x01sb.", ""),  # ... of a function
        (b"\x80\x02ccollections\nOrderedDict\n(N}U\x01xK\x01stb.", ""),  # ... through slots
        (b"\x80\x02cnumpy\nndarray\n.", ""),  # a class as a value
        (b"\x80\x02cnumpy\nndarray\nK\x05\x85R.", ""),  # a class called
        (b"(S'x'\ni__builtin__\neval\n.", ""),  # an instance of an old class
        (b"\x80\x02cnumpy\nndarray\n)\x81.", ""),  # NEWOBJ
        (b"\x80\x04\x8c\x05numpy\x8c\x07ndarray\x93)}\x92.", ""),  # NEWOBJ_EX
        (b"\x80\x05\x97.", ""),  # out-of-band buffer
        (b"\x80\x02c_codecs\nencode\nX\x01\x00\x00\x00aX\x03\x00\x00\x00zip\x86R.", ""),
    ],
)
def test_what_asks_for_more_is_refused(content, message):
    before = dict(vars(np.ndarray))
    with pytest.raises(DataError, match=message) as refused:
        loads_pickle(content)
    assert isinstance(refused.value, UnsafePickleError) or message.startswith("STACK_GLOBAL")
    assert dict(vars(np.ndarray)) == before


def test_declared_sizes_never_allocate():
    np.testing.assert_array_equal(loads_pickle(array_of(b"K\x01\x85")), [0.0])
    with pytest.raises(DataError, match="the file holds 8"):
        loads_pickle(array_of(b"\x8a\x05\x00\x00\x00\x00\x20\x85"))  # 2^37 elements
    with pytest.raises(DataError):
        loads_pickle(array_of(b"J\xff\xff\xff\xff\x85"))  # a negative size
    with pytest.raises(DataError):  # 2^60 bytes of text announced
        loads_pickle(b"\x80\x04\x8e" + struct.pack("<Q", 2**60) + b"abc.")
    with pytest.raises(UnsafePickleError, match="memory"):
        loads_pickle(b"\x80\x02]r" + struct.pack("<I", 2**31) + b".")  # slot 2^31 of the memo
    with pytest.raises(UnsafePickleError, match="memory"):
        loads_pickle(b"]p2147483648\n.")


def test_exponential_and_cyclic_containers():
    value = [1.0]
    for _ in range(40):
        value = [value, value]  # 2^40 leaves, 40 objects
    loaded = loads_pickle(pickle.dumps(value))
    assert loaded[0] is loaded[1]
    cyclic = []
    cyclic.append(cyclic)
    with pytest.raises(UnsafePickleError, match="holds itself"):
        loads_pickle(pickle.dumps(cyclic))
    deep = []
    for _ in range(200):
        deep = [deep]
    with pytest.raises(UnsafePickleError, match="nested"):
        loads_pickle(pickle.dumps(deep))


def test_damaged_files(tmp_path):
    content = pickle.dumps({"robot": {"c_pos": np.arange(30.0).reshape(10, 3)}})
    for end in range(len(content)):
        with pytest.raises(DataError, match="not a complete pickle"):
            loads_pickle(content[:end])
    path = tmp_path / "empty.pkl"
    path.touch()
    with pytest.raises(DataError, match=r"empty\.pkl.*not a complete pickle"):
        load_pickle(path)
    lengths = (
        b"\x80\x04\x95" + b"\xff" * 7 + b"\x7fN.",
        b"\x80\x02X\xff\xff\xff\x7fa.",
        b"\x80\x02\x8b\xff\xff\xff\x7f\x01.",
    )
    for other in (b"not a pickle", b"\x00" * 50, b"PK\x03\x04", b"(.", b".", b"\x80\xff.", content + b"more", *lengths):
        with pytest.raises(DataError):
            loads_pickle(other)
    with pytest.raises(FileNotFoundError):
        load_pickle(tmp_path / "absent.pkl")


@settings(max_examples=150, deadline=None)
@given(st.data())
def test_random_damage_never_escapes(data):
    content = bytearray(pickle.dumps({"a": np.arange(4.0), "b": [1, "x"]}, data.draw(st.sampled_from(list(PROTOCOLS)))))
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    try:
        loads_pickle(bytes(content))
    except DataError:
        pass

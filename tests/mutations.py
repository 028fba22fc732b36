"""Files with something wrong in them: what a hand, a disk or a stranger may make of a good one.

`mutated` changes the bytes of any file, the values of a JSON or TOML file, or the members of a NumPy archive.
"""

import io
import json
import random
import struct
import warnings
import zipfile

import numpy as np

# What takes the place of a value in JSON: numbers that overflow, texts that lead elsewhere, depth, size.
BAD_JSON = (
    "null",
    "true",
    "-1",
    "0",
    "1e999",
    "-1e999",
    "NaN",
    "1" + "0" * 400,
    "1" + "0" * 5000,
    "1e-320",
    "1e300",
    "2147483648",
    '""',
    '"../../x"',
    '"/tmp/x"',
    '"a\\nb"',
    '"\\u0000"',
    '"\\ud800"',
    '"' + "x" * 5000 + '"',
    "[]",
    "{}",
    "[" * 5000 + "]" * 5000,
    "[0.1, 0.1, 0.1]",
    "[" + "0.1," * 20000 + "0.1]",
    '{"a": {"a": {"a": 1}}}',
)
BAD_TOML = (
    "true",
    "-1",
    "0",
    "inf",
    "nan",
    "1" + "0" * 400,
    "1" + "0" * 5000,
    "1e300",
    "1e-320",
    "9223372036854775808",
    '""',
    '"../../x"',
    '"a\\nb"',
    '"""a\nb"""',
    '"' + "x" * 5000 + '"',
    "[]",
    "{}",
    "[" * 5000 + "]" * 5000,
    "[0.1, 0.1, 0.1]",
    "[" + "0.1," * 20000 + "0.1]",
    "1979-05-27T07:32:00Z",
    "{ a = { b = 1 } }",
)
BAD_BYTES = (b"", b"\xff\xfe", b"\x00", b"\xc3\x28", b"\xef\xbb\xbf", b"{", b"PK\x03\x04", b"\n", b'"')


def damaged(rng, data):
    """A file whose bytes were cut, changed, doubled or filled with others."""
    data = bytearray(data)
    way = rng.randrange(6)
    at = rng.randrange(len(data) + 1)
    if way == 0:
        return bytes(data[:at])
    if way == 1:
        for _ in range(rng.choice((1, 3, 30))):
            data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        return bytes(data)
    if way == 2:
        return bytes(data[:at]) + rng.choice(BAD_BYTES) + bytes(data[at:])
    if way == 3:
        end = rng.randrange(at, len(data) + 1)
        return bytes(data[:at] + data[end:])
    if way == 4:
        return rng.choice(BAD_BYTES) * rng.choice((1, 100))
    return bytes(data[:at]) + rng.randbytes(rng.choice((1, 10, 1000))) + bytes(data[at:])


def _places(value, path=()):
    """The paths of all values in a JSON value."""
    yield path
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, part in items:
        yield from _places(part, (*path, key))


MARK = "%MARK%"


def mutated_json(rng, data):
    """JSON in which a value is another one, a key another key, or something is missing or there twice."""
    value = json.loads(data)
    path = rng.choice([path for path in _places(value) if path])
    inside = value
    for key in path[:-1]:
        inside = inside[key]
    way = rng.randrange(4)
    if way == 0:
        del inside[path[-1]]
    elif way == 1 and isinstance(inside, dict):
        inside[rng.choice(("", "x", "naem", "a\nb", "x" * 5000))] = inside.pop(path[-1])
    elif way == 1:
        inside.append(inside[path[-1]])
    else:
        inside[path[-1]] = MARK
        return json.dumps(value).replace(f'"{MARK}"', rng.choice(BAD_JSON)).encode()
    return json.dumps(value).encode()


def mutated_toml(rng, data):
    """TOML, one key a line, in which a value, a key or a table is another one, missing, or there twice."""
    lines = data.decode().splitlines()
    at = rng.choice([i for i, line in enumerate(lines) if "=" in line or line.startswith("[")])
    way = rng.randrange(4)
    if way == 0:
        del lines[at]
    elif way == 1:
        lines.insert(rng.randrange(len(lines)), lines[at])
    elif "=" not in lines[at]:
        lines[at] = rng.choice(("[x]", "[[camera]]", "[camera.x]", "[]", '["a\\nb"]', "[" + "a." * 2000 + "a]"))
    elif way == 2:
        key = rng.choice(("x", "a.b", '""', '"a\\nb"', "widht", ".".join("a" * 2000)))
        lines[at] = f"{key} = {lines[at].split('=', 1)[1]}"
    else:
        lines[at] = f"{lines[at].split('=', 1)[0]}= {rng.choice(BAD_TOML)}"
    return "\n".join(lines).encode()


def bad_array(rng, array):
    """Another array in the place of one."""
    return rng.choice(
        (
            lambda: array.astype(complex) if array.dtype.kind in "fiu" else np.zeros(3),
            lambda: array[:-1] if array.ndim else array[None],
            lambda: array[None],
            lambda: np.full(array.shape, np.nan, np.float16),
            lambda: np.full(array.shape, 1e300),
            lambda: np.full(array.shape, "x"),
            lambda: np.zeros(array.shape, "M8[s]"),
            lambda: np.zeros(array.shape, [("a", "f4"), ("b", "i4")]),
            lambda: np.zeros((0, *array.shape), array.dtype),
            lambda: np.zeros((2000, 2000), np.float32),
            lambda: np.array(["../../x" * 1000]),
        )
    )()


def mutated_archive(rng, data, change_text=None):
    """A NumPy archive, whole as a ZIP file, in which a member is another, damaged, missing, or too large to be true.

    Args:
      rng: draws.
      data: the archive.
      change_text: draws another one for a member that is a text; None where none is.
    """
    with np.load(io.BytesIO(data)) as saved:
        arrays = dict(saved)
    name = rng.choice(list(arrays))
    raw: dict[str, bytes] = {}
    way = rng.randrange(7)
    if way == 0:
        del arrays[name]
    elif way == 1:
        arrays[rng.choice(("x", "../../x", "a/b", "x" * 5000, "a\nb"))] = arrays.pop(name)
    elif way == 2 and arrays[name].dtype.kind == "U" and change_text:
        arrays[name] = np.array(change_text(rng, str(arrays[name]).encode()).decode(errors="replace"))
    elif way in (2, 3):
        arrays[name] = bad_array(rng, arrays[name])
    else:
        member = io.BytesIO()
        np.save(member, arrays.pop(name))
        whole = member.getvalue()
        if way == 4:
            raw[name] = damaged(rng, whole)
        elif way == 5:
            shape = rng.choice((b"(10000000000000,)", b"(1" + b"0" * 400 + b",)", b"(-1,)", b"((((((", b"(1.5,)"))
            header = b"{'descr': '<f4', 'fortran_order': False, 'shape': " + shape + b", }\n"
            raw[name] = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + b"\0" * 64
        else:
            raw[name] = b"\0" * rng.choice((1_000, 2_000_000))
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    with warnings.catch_warnings(), zipfile.ZipFile(buffer, "a", zipfile.ZIP_DEFLATED) as archive:
        # That names are there twice is meant.
        warnings.simplefilter("ignore")
        for key, content in raw.items():
            archive.writestr(f"{key}.npy", content)
            if rng.random() < 0.3:
                archive.writestr(rng.choice(("../../x.npy", "/tmp/x.npy", f"{key}.npy")), content)
    return buffer.getvalue()


def bomb():
    """An archive of a few kilobytes that unpacks to 16 MiB."""
    buffer = io.BytesIO()
    with (
        zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("depth.npy", "w", force_zip64=True) as member,
    ):
        block = b"\0" * 2**20
        for _ in range(16):
            member.write(block)
    return buffer.getvalue()


def seeded(kind, number):
    return random.Random(f"{kind} {number}")

"""Seeded mutations of files: of single bytes, and of the structure of a format.

Each takes a ``random.Random`` and the bytes of a valid file, and returns the bytes of another file. They use only the
standard library, and no code of the package.
"""

from __future__ import annotations

import copy
import io
import json
import re
import sqlite3
import stat
import struct
import tempfile
import xml.etree.ElementTree as ET
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from random import Random
from typing import Any, Literal

Mutation = Callable[[Random, bytes], bytes]

NUMBERS = (
    "",
    "0",
    "-0.0",
    "-1",
    "3",
    "nan",
    "inf",
    "-inf",
    "INF",
    "1e308",
    "-1e308",
    "1e999",
    "1e-320",
    "1e9",
    "1e15",
    "99999999999999999999",
    "18446744073709551615",
    "-9223372036854775809",
    "0x10",
    "1,5",
    "1_0",
    "1 2",
    "1 2 3",
    "1e308 1e308 1e308",
    "true",
    "None",
    "٣",
    "1" * 5000,
)
PATHS = (
    "package://../../secret",
    "package://meshes/../../../secret",
    "package://%2e%2e/%2e%2e/secret",
    "../../secret",
    "/etc/passwd",
    "file:///etc/passwd",
    "file:///dev/zero",
    "/dev/zero",
    "file:///proc/self/mem",
    "package://meshes/",
    "package://",
    "http://[",
    "C:\\x",
    "\x7f",
    "package://meshes/" + "a" * 5000,
    "package://" + "a/" * 3000,
    "package://meshes/%00",
)
WORDS = (
    " ",
    "x",
    "x" * 100_000,
    "ö→𝄞",
    "\u202eabc",
    "a\nb",
    "a\tb",
    "%s%n%d",
    "${x}",
    "'\"<>&",
    "__init__",
    "..",
    "/",
    "\\",
    "2.0",
    "3.0",
    "1.0",
    "input",
    "output",
    "parameter",
    "local",
    "Real",
    "Integer",
    "revolute",
    "prismatic",
    "continuous",
    "fixed",
    "floating",
    "planar",
)


def value(rng: Random) -> str:
    return rng.choice(rng.choice((NUMBERS, NUMBERS, PATHS, WORDS)))


def several(*edits: Mutation, most: int = 3) -> Mutation:
    """Make one to ``most`` edits in turn."""

    def mutate(rng: Random, data: bytes) -> bytes:
        for _ in range(rng.randint(1, most)):
            data = rng.choice(edits)(rng, data)
        return data

    return mutate


# --- bytes ---


def flip(rng: Random, data: bytes) -> bytes:
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 8)) if data else 0):
        changed[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    return bytes(changed)


def put(rng: Random, data: bytes, at: int, size: int, order: Literal["little", "big"] = "little") -> bytes:
    """Replace an integer by another one, often one too large, or far too large."""
    old, top = int.from_bytes(data[at : at + size], order), 256**size - 1
    new = rng.choice(
        (
            0,
            1,
            2,
            5,
            8,
            10,
            12,
            13,
            14,
            93,
            95,
            99,
            255,
            512,
            4096,
            65535,
            2**16,
            2**31 - 1,
            2**31,
            2**32 - 1,
            2**40,
            2**63 - 1,
            2**63,
            top,
            top - 1,
            top // 2,
            len(data),
            rng.randrange(top),
            old ^ 1,
            old ^ 8,
            old + 1,
            old - 1,
            2 * old,
            old // 2,
        )
    )
    return data[:at] + (new % (top + 1)).to_bytes(size, order) + data[at + size :]


def overwrite(rng: Random, data: bytes) -> bytes:
    at = rng.randrange(len(data) + 1)
    return put(rng, data, at, rng.choice((1, 2, 4, 8)), rng.choice(("little", "big")))


def region(rng: Random, data: bytes) -> bytes:
    """Delete, repeat, fill or randomise some bytes, copy them elsewhere, or cut the file there."""
    start = rng.randrange(len(data) + 1)
    end = start + rng.randint(0, rng.choice((1, 4, 64, 4096, len(data))))
    part, at = data[start:end], rng.randrange(len(data) + 1)
    filled = rng.choice((b"\0", b"\xff", b" ", b"<")) * len(part)
    noise = rng.randbytes(rng.choice((1, 16, 1000)))
    instead = rng.choice((b"", part * rng.randint(2, 4), filled, noise + part))
    edits = (data[:start] + instead + data[end:], data[:at] + part + data[at + len(part) :])
    return rng.choice((edits[0], edits[0], edits[1], data[:start]))


def magic(rng: Random, data: bytes) -> bytes:
    new = rng.choice((b"PK\3\4", b"\x89MCAP0\r\n", b"SQLite format 3\0", b"<?xml", b"\0" * 8))
    return new + data[len(new) :]


def nothing(rng: Random, data: bytes) -> bytes:
    return data


blind = several(flip, overwrite, region, region, region, magic)


# --- text ---


def _token(rng: Random, data: bytes) -> bytes:
    """Replace a word or a number."""
    tokens = [*re.finditer(rb"[\w.+-]+", data)]
    if not tokens:
        return data
    token = rng.choice(tokens)
    return data[: token.start()] + value(rng).encode() + data[token.end() :]


def _lines(rng: Random, data: bytes) -> bytes:
    """Drop, move, repeat or indent a line."""
    lines = data.splitlines(keepends=True) or [b""]
    line = lines.pop(rng.randrange(len(lines)))
    indented = rng.choice((b" ", b"\t", b"  - ", b"#")) + line
    at = rng.randrange(len(lines) + 1)
    lines[at:at] = rng.choice(([], [line], [line, line], [indented]))
    return b"".join(lines)


def _encoding(rng: Random, data: bytes) -> bytes:
    change = rng.choice(("utf-16", "utf-32", "utf-7", "cp037", "latin-1", "BOM", "NUL", "ends"))
    if change == "BOM":
        return b"\xef\xbb\xbf" + data
    if change == "NUL":
        at = rng.randrange(len(data) + 1)
        return data[:at] + b"\0" + data[at:]
    if change == "ends":
        return data.replace(b"\n", rng.choice((b"\r", b"\r\n", b"\n\n", b"", b"\x0b")))
    return data.decode("utf-8", "replace").encode(change, "replace")


text = several(_token, _token, _lines, _encoding, flip, region)


# --- XML ---


def _xml_tree(rng: Random, data: bytes) -> bytes:
    """Make one to three changes of elements and attributes."""
    try:
        root = ET.fromstring(data)
        for _ in range(rng.randint(1, 3)):
            _edit_tree(rng, root)
        return ET.tostring(root, encoding="utf-8", xml_declaration=True)
    except (ET.ParseError, ValueError, LookupError, RecursionError):
        return data  # an earlier edit has left no tree to change


def _edit_tree(rng: Random, root: ET.Element) -> None:
    parents = {child: parent for parent in root.iter() for child in parent}
    element = rng.choice([*parents] or [root])
    parent = parents.get(element, root)
    holders = [e for e in root.iter() if e.attrib]
    holder = element if element.attrib else rng.choice(holders)
    key = rng.choice([*holder.attrib])
    edits = ("set", "set", "set", "take", "take", "unset", "text", "name", "copy", "drop", "move")
    match rng.choice(edits):
        case "set":
            holder.set(key, value(rng))
        case "take":  # what another has: one name twice, two parents, parents in a circle
            holder.set(key, rng.choice([e.attrib[key] for e in holders if key in e.attrib]))
        case "unset":
            del holder.attrib[key]
        case "text":
            element.text = value(rng)
        case "name":
            other = rng.choice([*root.iter()]).tag
            element.tag = rng.choice((other, "x", "{http://x}y", element.tag.upper()))
        case "copy":
            for _ in range(rng.choice((1, 1, 3, 200))):
                parent.insert(rng.randrange(len(parent) + 1), copy.deepcopy(element))
        case edit:
            parent.remove(element)
            if edit == "move":
                rng.choice([*root.iter()]).append(element)


xml = several(_xml_tree, _xml_tree, _xml_tree, _xml_tree, _encoding, _token, blind, most=2)


# --- CSV ---

CELLS = ('"', '"1', '1"2', '"1,2"', "'1'", "\0", ";", "1;2", "x_des[3]", "q[1]")


def _cells(rng: Random, data: bytes) -> bytes:
    rows = [line.split(",") for line in data.decode("utf-8", "replace").splitlines()] or [[""]]
    row = rng.choice(rows)
    i, kind = rng.randrange(len(row)), rng.randrange(7)
    if kind <= 1:
        row[i] = rng.choice((value(rng), value(rng), rng.choice(CELLS), row[i] * 200_000))
    elif kind == 2:
        for other in rows:
            del other[i : i + 1]
    elif kind == 3:
        for other in rows:
            other.insert(i, other[i] if i < len(other) else "0")
    elif kind == 4:
        rng.shuffle(rows)
    elif kind == 5:
        rows.insert(rng.randrange(len(rows) + 1), row * rng.choice((1, 2, 50_000)))
    else:
        rows += [row] * rng.choice((1, 20_000))
    return "\n".join(map(",".join, rows)).encode()


csv = several(_cells, _cells, _cells, _lines, _encoding, _token, blind)


# --- zip ---

LOCAL, CENTRAL, END = b"PK\3\4", b"PK\1\2", b"PK\5\6"
ZIP_FIELDS = {
    # offset and size of what a reader believes, by record
    LOCAL: [(4, 2), (6, 2), (8, 2), (10, 4), (14, 4), (18, 4), (22, 4), (26, 2), (28, 2)],
    CENTRAL: [(6, 2), (8, 2), (10, 2), (16, 4), (20, 4), (24, 4), (28, 2), (30, 2), (32, 2), (34, 2), (38, 4), (42, 4)],
    END: [(4, 2), (6, 2), (8, 2), (10, 2), (12, 4), (16, 4), (20, 2)],
}
ZIP_NAMES = (
    "../evil",
    "resources/../../evil",
    "/evil",
    "//evil",
    "..\\evil",
    "C:evil",
    "C:\\evil",
    "",
    ".",
    "..",
    "resources",
    "resources/robot.urdf/x",
    "modelDescription.xml",
    "./x",
    "~/evil",
    "modelDescription.xml/",
    "binaries/linux64/../../../evil",
    "a" * 300,
    "a/" * 2100 + "b",
    "a\nb",
    "\x1b[31m",
    "con",
    "ö",
    "resources/robot.urdf",
    "binaries/linux64/other.so",
    "x/",
    "a\0b",
)


def _zip_field(rng: Random, data: bytes) -> bytes:
    """Change a field of a header: sizes, offsets, flags (encryption, data descriptors), methods."""
    kind = rng.choice((LOCAL, CENTRAL, CENTRAL, CENTRAL, END))
    places = [match.start() for match in re.finditer(re.escape(kind), data)]
    if not places:
        return data
    offset, size = rng.choice(ZIP_FIELDS[kind])
    return put(rng, data, rng.choice(places) + offset, size)


def _zip_member(rng: Random, data: bytes) -> bytes:
    """Add or change a member, or compress all by another method."""
    members = _members(data)
    if not members:
        return data
    name, victim = rng.choice(ZIP_NAMES), rng.choice([*members])
    link, method = ((stat.S_IFLNK | 0o777) << 16, rng.choice((0, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)))
    target = rng.choice((b"/", b"..", b"/etc/passwd", b"../../secret", victim.encode()))
    attributes = rng.choice((link, 0o40755 << 16, stat.S_IFIFO << 16, 0x10, 0xFFFFFFFF))
    match rng.randrange(7):
        case 0:
            return zip_of({**members, name: rng.randbytes(20)})
        case 1:
            return zip_of({name if n == victim else n: value for n, value in members.items()})
        case 2:  # a link, and a member behind it
            linked = {"resources/l": target, "resources/l/evil": b"x", **members}
            return zip_of(linked, attributes={"resources/l": link})
        case 3:
            return zip_of(members, twice=victim)
        case 4:
            return zip_of(members, attributes={victim: attributes})
        case 5:
            return zip_of({n: value for n, value in members.items() if n != victim})
    packed = zip_of(members, method=method)
    return rng.choice((flip, flip, overwrite, nothing))(rng, packed)


container = several(_zip_field, _zip_field, _zip_member, blind, most=2)


def _members(data: bytes) -> dict[str, bytes] | None:
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            if sum(entry.file_size for entry in archive.infolist()) > 2**26:
                return None
            return {name: archive.read(name) for name in archive.namelist()}
    except Exception:  # an earlier edit has damaged it
        return None


def zip_of(
    members: Mapping[str, bytes],
    *,
    method: int = zipfile.ZIP_STORED,
    attributes: Mapping[str, int] | None = None,
    twice: str | None = None,
) -> bytes:
    """Return a zip archive with names as given, one of which occurs twice."""
    again = [] if twice is None else [(twice, b"x")]
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name, content in [*members.items(), *again]:
            entry = zipfile.ZipInfo("x")
            entry.filename = name
            entry.compress_type = method
            entry.external_attr = (attributes or {}).get(name, 0o644 << 16)
            archive.NameToInfo.pop(name, None)  # or zipfile warns
            archive.writestr(entry, content)
    return file.getvalue()


def raw_zip(members: Iterable[tuple[str, bytes, int, int]]) -> bytes:
    """Return a zip archive of names, deflated data, and stated sizes and checksums.

    Data that is the same object is written once: its members overlap.
    """
    body, directory = bytearray(), bytearray()
    offsets: dict[int, int] = {}
    for name, packed, size, crc in members:
        fields = (0, 8, 0, 33, crc, len(packed), size, len(name), 0)
        if id(packed) not in offsets:
            offsets[id(packed)] = len(body)
            body += struct.pack("<4s5H3L2H", LOCAL, 20, *fields) + name.encode() + packed
        directory += struct.pack("<4s2H", CENTRAL, 20, 20) + struct.pack("<4H3L2H", *fields)
        directory += struct.pack("<3H2L", 0, 0, 0, 0, offsets[id(packed)]) + name.encode()
    return bytes(body + directory) + struct.pack("<4s4H2LH", END, 0, 0, 0xFFFF, 0xFFFF, len(directory), len(body), 0)


def deflated_zeros(size: int) -> bytes:
    """Return a number of deflated zeros, a multiple of 1 MiB, without compressing all."""
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    block = packer.compress(bytes(2**20)) + packer.flush(zlib.Z_FULL_FLUSH)
    return block * (size // 2**20) + zlib.compressobj(9, zlib.DEFLATED, -15).flush()


def member(mutations: Mapping[str, Mutation], kept: str = "$") -> Mutation:
    """Mutate the content of one member by the mutation of a pattern that matches its name.

    Members that match ``kept`` are unchanged.
    """

    def mutate(rng: Random, data: bytes) -> bytes:
        members = dict(_members(data) or {})
        pattern = rng.choice(list(mutations))
        name = rng.choice([n for n in members if re.match(pattern, n) and not re.match(kept, n)])
        members[name] = mutations[pattern](rng, members[name])
        return zip_of(members)

    return mutate


# --- JSON ---


def _json_node(rng: Random, data: bytes) -> bytes:
    try:
        tree = json.loads(data)
        node, key = rng.choice(list(_json_places(tree)))
    except (ValueError, IndexError, RecursionError):
        return data  # an earlier edit has left no tree to change
    if rng.random() < 0.25:
        del node[key]
    else:
        node[key] = rng.choice(
            (
                value(rng),
                value(rng),
                value(rng),
                None,
                True,
                -1,
                0,
                1e308,
                float("nan"),
                float("inf"),
                10**30,
                "",
                [],
                {},
                [[]],
                {"": 0},
                [None],
                [1, "2"],
                [[0, {}]],
            )
        )
    return json.dumps(tree).encode()


def _json_places(node: Any) -> Iterator[tuple[Any, Any]]:
    if isinstance(node, dict | list):
        for key, child in list(node.items() if isinstance(node, dict) else enumerate(node)):
            yield node, key
            yield from _json_places(child)


def _json_text(rng: Random, data: bytes) -> bytes:
    return rng.choice((b"[" * 5000 + b"]" * 5000, b"[" * 200_000, b"[1e400]", b"9" * 5000, b'"'))


json_tree = several(_json_node, _json_node, _json_node, _json_text, _token, blind, most=2)


# --- MCAP ---

MCAP_MAGIC = b"\x89MCAP0\r\n"
CHUNK = b"\x06"


def mcap_records(data: bytes) -> list[bytes]:
    """Return records with their heads; the last item is the rest, in a valid file the closing magic."""
    records = []
    start = len(MCAP_MAGIC)
    while start + 9 <= len(data):
        end = start + 9 + int.from_bytes(data[start + 1 : start + 9], "little")
        if end > len(data):
            break
        records.append(data[start:end])
        start = end
    return [*records, data[start:]]


def _mcap_records(rng: Random, data: bytes) -> bytes:
    """Drop, repeat or exchange records, or change their kind, length or numbers."""
    records = mcap_records(data)
    chunks = [i for i, record in enumerate(records) if record[:1] == CHUNK]
    i, j = rng.randrange(len(records)), rng.randrange(len(records))
    match rng.choice(("drop", "repeat", "swap", "kind", "length", "blind", *["number"] * 6)):
        case "drop":
            del records[i]
        case "repeat":
            records[j:j] = [records[i]] * rng.choice((1, 2, 500))
        case "swap":
            records[i], records[j] = records[j], records[i]
        case "kind":
            records[i] = bytes([rng.randrange(20)]) + records[i][1:]
        case "length":
            records[i] = put(rng, records[i], 1, 8)
        case "blind":
            records[i] = records[i][:9] + blind(rng, records[i][9:])
        case _:  # lengths and offsets among them; of chunks more often
            i = rng.choice(chunks) if chunks and rng.random() < 0.4 else i
            at = 9 + rng.randrange(min(len(records[i]), 64) + 1)
            records[i] = put(rng, records[i], at, rng.choice((2, 4, 8)))
    return data[: len(MCAP_MAGIC)] + b"".join(records)


def _mcap_chunk(rng: Random, data: bytes) -> bytes:
    """Mutate the content of a chunk, and remove its checksum."""
    records = mcap_records(data)
    chunks = [i for i, record in enumerate(records) if record[:1] == CHUNK and len(record) > 49]
    if not chunks:
        return data
    i = rng.choice(chunks)
    body = records[i][9:]
    name_end = 32 + int.from_bytes(body[28:32], "little")
    inner = body[name_end + 8 :]
    compressed = name_end > 32
    inner = blind(rng, inner) if compressed else _mcap_records(rng, MCAP_MAGIC + inner)[8:]
    size = len(inner).to_bytes(8, "little")
    unzipped = body[16:24] if compressed else size
    body = body[:16] + unzipped + bytes(4) + body[28:name_end] + size + inner
    records[i] = CHUNK + len(body).to_bytes(8, "little") + body
    return data[: len(MCAP_MAGIC)] + b"".join(records)


mcap = several(_mcap_records, _mcap_records, _mcap_records, _mcap_chunk, blind)


# --- SQLite ---

SQLITE_FIELDS = [
    (16, 2),
    (18, 1),
    (19, 1),
    (20, 1),
    (21, 1),
    (24, 4),
    (28, 4),
    (32, 4),
    (36, 4),
    (40, 4),
    (44, 4),
    (52, 4),
    (56, 4),
    (60, 4),
    (64, 4),
    (92, 4),
    (96, 4),
]
STATEMENTS = (
    "DROP TABLE {table}",
    "DELETE FROM {table}",
    "ALTER TABLE {table} RENAME TO other",
    "UPDATE messages SET timestamp = {number}",
    "UPDATE messages SET topic_id = {number}",
    "UPDATE messages SET data = x'00'",
    "UPDATE messages SET data = 'text'",
    "UPDATE messages SET data = zeroblob(3000000) WHERE id < 10",
    "UPDATE messages SET data = substr(data, 1, 40) WHERE id = 3",
    "UPDATE messages SET timestamp = 'noon' WHERE id = 2",
    "UPDATE messages SET timestamp = timestamp + {number} WHERE id = 4",
    "UPDATE topics SET type = 'no/msg/Such'",
    "UPDATE topics SET name = {number}",
    "UPDATE topics SET offered_qos_profiles = '- [', serialization_format = 'json'",
    "UPDATE topics SET offered_qos_profiles = x'ff'",
    "INSERT INTO topics SELECT id + 100, name, type, serialization_format,"
    " offered_qos_profiles, type_description_hash FROM topics",
    "UPDATE message_definitions SET encoding = 'x'",
    "UPDATE message_definitions SET encoded_message_definition = x'ff'",
    "UPDATE schema SET schema_version = {number}",
    "UPDATE metadata SET metadata = '['",
    "INSERT INTO messages(topic_id, timestamp, data) SELECT topic_id, timestamp, data FROM messages",
)
TABLES = ("messages", "topics", "schema", "metadata", "message_definitions")


def _sqlite_number(rng: Random, data: bytes) -> bytes:
    """Change a field of the header, or in the head of a page its kind, free blocks, cells or pointers."""
    page = 4096 * rng.randrange(max(1, len(data) // 4096))
    of_page = (page + (0 if page else 100) + rng.randrange(16), rng.choice((1, 2, 4)))
    at, size = rng.choice((of_page, of_page, rng.choice(SQLITE_FIELDS)))
    return put(rng, data, at, size, "big")


def _sqlite_statement(rng: Random, data: bytes) -> bytes:
    number = rng.choice((0, -1, 2**62, -(2**62), 2**63 - 1, 1.5, 1e300))
    statement = rng.choice(STATEMENTS).format(table=rng.choice(TABLES), number=number)
    return sqlite_after(data, statement)


def sqlite_after(data: bytes, script: str) -> bytes:
    """Return the database after some SQL, unchanged if the SQL fails."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "db")
        path.write_bytes(data)
        connection = sqlite3.connect(path)
        try:
            connection.executescript(script)
        except (sqlite3.Error, UnicodeDecodeError):  # an earlier edit has damaged it
            return data
        finally:
            connection.close()
        return path.read_bytes()


sqlite = several(_sqlite_number, _sqlite_number, _sqlite_number, _sqlite_statement, blind)

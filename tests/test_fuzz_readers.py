"""Files with bytes changed at random: read, or a ValueError that names the file.

`benchmarks/fuzz_readers.py` does the same for longer, led by coverage; docs/fuzzing.md says what
is tried.
"""

from __future__ import annotations

import random
from typing import Any

import pytest

from rbl_gym.recordings import Files, Format, read_recording
from tests import fuzz_files
from tests.fuzz_files import READERS, check

MUTANTS = 40  # of each good file; docs/fuzzing.md states it

NAMES = list(READERS)


def mutant(data: bytes, words: tuple[bytes, ...], rng: random.Random) -> bytes:
    """`data` with one to four pieces replaced, dropped, doubled, cut off or flipped."""
    for _ in range(rng.randint(1, 4)):
        start = rng.randint(0, len(data))
        end = min(len(data), start + rng.choice((0, 1, 1, 2, 5, 20)))
        change = rng.choice(("word", "word", "drop", "double", "cut", "flip"))
        if change == "word":
            data = data[:start] + rng.choice(words) + data[end:]
        elif change == "drop":
            data = data[:start] + data[end:]
        elif change == "double":
            data = data[:end] + data[start:]
        elif change == "cut":
            data = data[:start] if rng.random() < 0.2 else data
        elif data:
            at = rng.randrange(len(data))
            data = data[:at] + bytes([data[at] ^ (1 << rng.randrange(8))]) + data[at + 1 :]
    return data


@pytest.mark.parametrize("name", NAMES)
def test_mutants(name, tmp_path):
    reader, rng = READERS[name], random.Random(0)
    results = set()
    for seed in reader.seeds:
        assert check(name, seed, tmp_path) == "read"
        for _ in range(MUTANTS):
            data = mutant(seed, reader.words, rng)
            try:
                results.add(check(name, data, tmp_path))
            except BaseException as error:
                error.add_note(f"{name} of {data!r:.2000}")
                raise
    assert len(results) > 2, results


@pytest.mark.parametrize("name", NAMES)
def test_no_file_at_all(name, tmp_path):
    data = [b"", b"\n", b"\0", b"\xff\xfe", b"[]", b"{}", b"null", b"[" * 20_000,
            b'{"a":' * 20_000, b"a = " + b"[" * 20_000, b"9" * 5000, b"a," * 20_000]  # fmt: skip
    for one in data:
        check(name, one, tmp_path)


NAMES_OF_COLUMNS = ("t", "time", "anchor", "tag", "range", "std", "valid", "ax", "ay", "run", "*")
CELLS = (
    "A", "1", "left", "t", "anchor", "tag", "range", "std", "valid", "x", "y", "z", "id", "t[ms]",
    "range[mm]", "*", "r*", "*e", "a{anchor}t{tag}", "{tag}", "{anchor}", "{anchor}{tag}", "{x}",
    "[s]", "", " ", "(", "[", "{anchor",
)  # fmt: skip


def test_formats(tmp_path):
    """Good files, read in any way that options can say."""
    rng = random.Random(0)
    seeds = [*READERS["ranges"].seeds, fuzz_files.RUNS, fuzz_files.ALONE, fuzz_files.PATTERN]
    beside = {"anchors": fuzz_files.ANCHORS, "tags": fuzz_files.TAGS, "truth": fuzz_files.TRUTH}
    for name, data in beside.items():
        (tmp_path / f"{name}.csv").write_bytes(data)
    read = 0

    def some(most: int) -> dict[str, str]:
        prefixes = ("", "", "", "anchors.", "tags.", "truth.", "carrier.", "a.", ".")
        return {
            rng.choice(prefixes) + rng.choice(NAMES_OF_COLUMNS): rng.choice(CELLS)
            for _ in range(rng.choice((0, 0, most)))
        }

    for _ in range(300):
        (tmp_path / "ranges.csv").write_bytes(rng.choice(seeds))
        options: dict[str, Any] = {
            "columns": some(2), "where": some(1), "strict": rng.random() < 0.2,
            "time_unit": rng.choice((None, None, "s", "ms", "ns", "iso", "h")),
            "unit": rng.choice((None, None, "m", "cm", "mm", "ft")),
        }  # fmt: skip
        parts = ["ranges", *(name for name in beside if rng.random() < 0.7)]
        files: dict[str, Any] = {part: tmp_path / f"{part}.csv" for part in parts}
        try:
            log = read_recording(Files(**files), format=Format(**options))
        except ValueError:
            continue
        except BaseException as error:
            error.add_note(f"{options} of {files}")
            raise
        fuzz_files.check_log(log)
        read += 1
    assert read > 10

"""Files with bytes changed at random: read, or a ValueError that names the file.

`benchmarks/fuzz_readers.py` does the same for longer, led by coverage; docs/fuzzing.md says what
was found.
"""

from __future__ import annotations

import random

import pytest

from tests.fuzz_files import READERS, check

MUTANTS = 150  # of each good file; docs/fuzzing.md says for how many it was run

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
    data = [b"", b"\n", b"\0", b"\xff\xfe", b"[]", b"{}", b"null", b"[" * 100_000,
            b'{"a":' * 100_000, b"a = " + b"[" * 100_000, b"9" * 5000, b"a," * 200_000]  # fmt: skip
    for one in data:
        check(name, one, tmp_path)

"""Readers of files under atheris, led by coverage: recordings, graphs, scenes, policies, records.

Every input must be read, or be refused by a ValueError that names the file (`tests/fuzz_files.py`,
which also has the good files to begin with). A crash is printed with its input.

    python -m pip install -e ".[fuzz]"
    python -m benchmarks.fuzz_readers [NAME ...] [--seconds 60]
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import tempfile
from pathlib import Path

INSTRUMENTED = [
    "rbl_gym.recordings.reading", "rbl_gym.recordings.text", "rbl_gym.recordings.tables",
    "rbl_gym.recordings.measured", "rbl_gym.recordings.points", "rbl_gym.recordings.stamps",
    "rbl_gym.recordings.truth", "rbl_gym.recordings.writing",
    "rbl_gym.placement.scene_files", "rbl_gym.networks.g2o",
    "rbl_gym.studies.learning.policies",
    "rbl_gym.studies.bench.records", "rbl_gym.studies.bench.spec_files",
    "csv", "json.decoder", "tomllib", "tomllib._parser",
    "numpy.lib.format", "numpy.lib._format_impl", "zipfile",
]  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help="readers; all by default")
    parser.add_argument("--seconds", type=int, default=60, help="for each reader")
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        fuzz(options.names[0], options.seconds)
        return
    from tests.fuzz_files import READERS

    failed = False
    for name in options.names or READERS:
        row, log = run(name, options.seconds)
        print(json.dumps(row), flush=True)
        if row["crashed"]:
            failed = True
            print(log[-4000:], file=sys.stderr)
    sys.exit(failed)


def run(name: str, seconds: int) -> tuple[dict[str, object], str]:
    """One reader in a process of its own, which libFuzzer ends as it likes."""
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.fuzz_readers", name, "--child", f"--seconds={seconds}"],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        check=False,
    )
    log = done.stdout.decode(errors="replace")
    runs = [int(n) for n in re.findall(r"#(\d+)", log)]
    edges = [int(n) for n in re.findall(r"cov: (\d+)", log)]
    row: dict[str, object] = {"reader": name, "seconds": seconds, "runs": max(runs, default=0)}
    return row | {"edges": max(edges, default=0), "crashed": done.returncode != 0}, log


def fuzz(name: str, seconds: int) -> None:
    import atheris

    with atheris.instrument_imports(include=INSTRUMENTED):
        from tests.fuzz_files import READERS, check
    reader = READERS[name]
    with tempfile.TemporaryDirectory() as place:
        folder, corpus = Path(place, "files"), Path(place, "corpus")
        folder.mkdir()
        corpus.mkdir()
        for k, seed in enumerate(reader.seeds):
            (corpus / str(k)).write_bytes(seed)
        words = Path(place, "words")
        words.write_text("".join(f'"{_escaped(word)}"\n' for word in reader.words if word))
        arguments = [
            sys.argv[0], str(corpus), f"-dict={words}", f"-max_total_time={seconds}",
            "-timeout=10", "-max_len=4096", f"-artifact_prefix={place}/",
        ]  # fmt: skip

        def once(data: bytes) -> None:
            try:
                check(name, data, folder)
            except BaseException as error:
                error.add_note(f"{name} of {data!r}")
                raise

        atheris.Setup(arguments, once)
        atheris.Fuzz()


def _escaped(word: bytes) -> str:
    return "".join(f"\\x{byte:02x}" for byte in word[:64])


if __name__ == "__main__":
    main()

"""What damage to a corpus, or to its writer, goes unseen: the table of tests/corpus_faults.py.

    python benchmarks/faults.py

Every kind of damage is done many times: detected means that ``verify`` names the file and exactly
the lost episodes (for rows that say "read": that reading raises), resumed that a stopped writer,
called again, gives the bytes of one that was not. One row more than the tests have is kept, the
default reader's, which looks at sizes: it does not see most flipped bits, and is not meant to.
"""

import sys
import tempfile
from pathlib import Path

from _report import write_report

sys.path.insert(0, str(Path(__file__).parents[1]))

from tests import corpus_faults


def main() -> None:
    with tempfile.TemporaryDirectory() as place:
        rows = corpus_faults.table(Path(place) / "all")
        corpus_faults.write(Path(place) / "read")
        by_size = corpus_faults.flipped_bits_read(Path(place) / "read", "size")
    tables = {"by_verify_and_writer": rows, "by_the_default_reader": [by_size]}
    results = {
        name: {row.fault: {**row._asdict(), "silent": row.silent} for row in found}
        for name, found in tables.items()
    }
    for entry in results.values():
        for row in entry.values():
            print(row)
            del row["fault"]
    settings = {
        "episodes": len(corpus_faults.EPISODES),
        "shard_bytes": corpus_faults.SHARD_BYTES,
        "bit_flips": corpus_faults.BIT_FLIPS,
        "kills": corpus_faults.KILLS,
    }
    print(write_report("faults", results, settings))


if __name__ == "__main__":
    main()

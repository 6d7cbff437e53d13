"""Flips every single bit of every recorded field of a journal and lets docs/verify_journal.py find it, in memory.

    every_bit.py DOCS-FOLDER RUN-FOLDER
"""
import sqlite3, sys
from pathlib import Path

sys.dont_write_bytecode = True
sys.path.insert(0, sys.argv[1])
import verify_journal as verifier  # noqa: E402


def flipped(value):
    """All values that differ from one in a single bit."""
    if isinstance(value, bytes):
        for bit in range(8 * len(value)):
            changed = bytearray(value)
            changed[bit // 8] ^= 1 << bit % 8
            yield bytes(changed)
    elif value is not None:
        for bit in range(63):
            yield value ^ 1 << bit
        yield value - 2**63


folder = Path(sys.argv[2])
rows = list(verifier.rows_of(sqlite3.connect(f"{folder.absolute().as_uri()}/journal.sqlite?mode=ro", uri=True)))
chain, bits = verifier.Chain(folder), 0
for number, row in enumerate(rows, 1):
    for column, value in enumerate(row):
        for changed in flipped(value):
            try:
                chain.take(verifier.record_of(row[:column] + (changed,) + row[column + 1 :]))
                sys.exit(f"{verifier.COLUMNS[column]} of record {number}: {changed} for {value} is not found")
            except verifier.Broken as broken:
                assert broken.record == number, (number, broken.record)
            bits += 1
    chain.take(verifier.record_of(row))
print(bits, "single bits, each found at its record")

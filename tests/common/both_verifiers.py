"""Has both verifiers prove every journal that the tests made and REGRIND_KEEP_JOURNALS kept: they must say the same.

    both_verifiers.py REGRIND FOLDER-OF-RUNS

Among them are journals that a test has broken; those are found by both, at the same record.
"""
import json, subprocess, sys
from pathlib import Path

sys.dont_write_bytecode = True
sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "docs"))
import verify_journal as other  # noqa: E402

regrind, runs = sys.argv[1], sorted(Path(sys.argv[2]).iterdir())
differing, signed, broken = 0, 0, 0
for run in runs:
    done = subprocess.run([regrind, "audit", "verify", "--json", run], capture_output=True, text=True)
    ours = json.loads(done.stdout) if done.stdout else {"absent": done.stderr}
    try:
        theirs = other.verify(run, [], [])
        code = 0 if theirs["sound"] and not theirs["lacks"] else 1
    except other.Absent as absent:
        theirs, code = {"absent": str(absent)}, 2
    compared = ["sound", "record", "records", "head", "anchored", "closed", "under_way", "artefacts", "keys", "seals", "signed"]
    if code != done.returncode or any(ours.get(k) != theirs.get(k) for k in compared):
        differing += 1
        print(f"{run}: they differ\n  {ours}\n  {theirs}\n  {done.stderr}")
    signed += bool(theirs.get("signed"))
    broken += not theirs.get("sound")
print(f"{len(runs)} journals proven by both verifiers, {signed} of them signed, {broken} broken, {differing} differ")
sys.exit(0 if runs and not differing and other.Ed25519PublicKey else 1)

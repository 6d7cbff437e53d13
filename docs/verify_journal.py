#!/usr/bin/env python3
"""Proves the record of a run of Regrind without Regrind, by docs/journal.md.

    verify_journal.py RUN-FOLDER|EXPORT.jsonl ... [--anchor FILE] [--key PUBLIC]... [--json]

Exit codes: 0 sound and whole; 1 broken, or not whole; 2 no such journal; 4 sound so far, and under way. Nothing in the folder is written.
"""
import argparse, fcntl, hashlib, json, os, shutil, sqlite3, sys, tempfile
from pathlib import Path

try:
    from cryptography.exceptions import InvalidSignature
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
except ImportError:
    Ed25519PublicKey = None

HASHED = "actor boot_id command_id cycle kind mono_ns part payload reason seq station utc".split()
COLUMNS = HASHED + ["prev_hash", "hash"]
TEXTS = set(COLUMNS) - {"command_id", "cycle", "mono_ns", "seq"}
KINDS = set("begin reopen event intent outcome artefact note seal end".split())
OWN = ("journal.sqlite", "journal.anchor", ".lock")
NOT_NULL = ", ".join(f"{k} {t} NOT NULL" for k, t in zip("utc boot_id mono_ns actor station kind part cycle".split(), "TEXT TEXT INTEGER TEXT TEXT TEXT TEXT INTEGER".split()))
SCHEMA = (
    f"CREATE TABLE record ( seq INTEGER PRIMARY KEY, {NOT_NULL}, command_id INTEGER, reason TEXT NOT NULL, payload TEXT NOT NULL, "
    "prev_hash TEXT NOT NULL, hash TEXT NOT NULL UNIQUE ) STRICT",
    "CREATE INDEX record_command ON record (command_id, kind) WHERE command_id IS NOT NULL",
    "CREATE TRIGGER record_is_not_changed BEFORE UPDATE ON record BEGIN SELECT RAISE(ABORT, 'records are not changed'); END",
    "CREATE TRIGGER record_is_not_deleted BEFORE DELETE ON record BEGIN SELECT RAISE(ABORT, 'records are not deleted'); END",
    "CREATE TRIGGER record_follows_the_last BEFORE INSERT ON record WHEN NEW.seq IS NOT (SELECT coalesce(max(seq), 0) + 1 FROM record) "
    "BEGIN SELECT RAISE(ABORT, 'records follow the last'); END",
)


class Broken(Exception):
    def __init__(self, record, what):
        self.record, self.what = record, what


class Absent(Exception):
    pass


def quoted(string):
    return json.dumps(string, ensure_ascii=False)


def parsed(text):
    def refused(word):
        raise ValueError(word)

    return json.loads(text, parse_constant=refused)


def is_hex(text, digits):
    return isinstance(text, str) and len(text) == digits and set(text) <= set("0123456789abcdef")


def text_of(r):
    shown = lambda k: r[k] if k == "payload" else quoted(r[k]) if k in TEXTS else "null" if r[k] is None else str(r[k])
    return "{" + ",".join(f'"{k}":{shown(k)}' for k in HASHED) + "}"


def hash_due(r):
    return hashlib.sha256(f"regrind journal record 1\n{r['prev_hash']}\n{text_of(r)}".encode()).hexdigest()


def is_signed(key, run, records, head, signature):
    if Ed25519PublicKey is None:
        return True
    message = f'regrind journal seal 1\n{{"head":{quoted(head)},"records":{records},"run":{quoted(run)}}}'.encode()
    try:
        Ed25519PublicKey.from_public_bytes(bytes.fromhex(key)).verify(bytes.fromhex(signature), message)
        return is_hex(signature, 128)
    except (InvalidSignature, ValueError):
        return False


class Chain:
    """What has been seen of a journal so far."""

    def __init__(self, folder=None, trusted=()):
        self.folder, self.trusted = folder, trusted
        self.records, self.head, self.ended, self.run, self.key = 0, "0" * 64, None, "", None
        self.no_author = None
        self.keys, self.seals, self.signed, self.files, self.last_intent, self.intents = [], 0, 0, 0, -1, set()

    def take(self, r):
        """Takes the next record: a dict of columns, or None where it cannot be read."""
        due = self.records + 1

        def hold(is_so, what):
            if not is_so:
                raise Broken(due, what)

        hold(r is not None, "a field cannot be read")
        hold(r["seq"] == due, f"it is missing: record {r['seq']} follows {self.records}")
        hold(r["prev_hash"] == self.head, "it does not follow the record before it")
        hold(r["hash"] == hash_due(r), "its content is not what was written")
        kind = r["kind"]
        hold((kind == "begin") == (due == 1), "a run begins with its first record, and only there")
        hold(self.ended is None or kind == "seal" and self.ended == self.records, "it stands behind the end of the run")
        try:
            payload = parsed(r["payload"])
        except (ValueError, RecursionError):
            hold(False, "its payload is no JSON")
        if kind in ("begin", "reopen", "artefact", "seal"):
            hold(isinstance(payload, dict), f"its payload is none of a {kind}")
            getattr(self, f"take_{kind}")(payload, hold)
        elif kind == "intent":
            hold(r["command_id"] is not None and r["command_id"] > self.last_intent, "its command number is not a new one")
            self.last_intent = r["command_id"]
            self.intents.add(r["command_id"])
        elif kind == "outcome":
            hold(r["command_id"] in self.intents, "it is the outcome of a command that is not on record")
        elif kind == "end":
            self.ended = due
        self.records, self.head = due, r["hash"]

    def take_begin(self, payload, hold):
        self.run = payload.get("run") if isinstance(payload.get("run"), str) else ""
        self.take_reopen(payload, hold)

    def take_reopen(self, payload, hold):
        self.key = payload.get("key")
        hold(self.key is None or is_hex(self.key, 64), "it names a key that is none")
        if self.trusted and self.key not in self.trusted and not self.no_author:
            at = self.records + 1
            unsigned = "the run is not signed" if at == 1 else f"it was gone on with at record {at} without a key"
            self.no_author = f"record {at} names the key {self.key}, which is none of those given" if self.key else unsigned
        if self.key and self.key not in self.keys:
            self.keys.append(self.key)

    def take_artefact(self, payload, hold):
        name, size, sha256 = (payload.get(k) for k in ("name", "bytes", "sha256"))
        parts = name.split("/") if isinstance(name, str) else [""]
        own = isinstance(name, str) and (name in OWN or name.startswith("journal.sqlite-") or "\\" in name)
        hold(isinstance(size, int) and not own and not {"", ".", ".."} & set(parts), "it names no file of a run folder")
        if self.folder is not None:
            path = self.folder.joinpath(*parts)
            hold(path.is_file(), f"the file {name} is missing")
            content = path.read_bytes() if path.stat().st_size == size else b""
            is_same = len(content) == size and hashlib.sha256(content).hexdigest() == sha256
            hold(is_same, f"the file {name} is not what was written")
        self.files += 1

    def take_seal(self, payload, hold):
        key, records, head, signature = (payload.get(k) for k in ("key", "records", "head", "signature"))
        hold(self.key and key == self.key, "it is sealed with another key than the one that the run names")
        hold((records, head) == (self.records, self.head), "it seals another record than the one before it")
        hold(is_signed(key, self.run, records, head, signature), "its signature is wrong")
        self.seals, self.signed = self.seals + 1, self.records

    def take_anchor(self, a):
        def hold(is_so, what):
            if not is_so:
                raise Broken(self.records, what)

        hold(a.get("run") in (None, self.run), "the anchor is of another run")
        hold(a["head"] == self.head, "its hash is not the one of the anchor")
        if self.key:
            signature = a.get("signature")
            hold(a.get("key") == self.key and is_hex(signature, 128), "the anchor is not signed with the key that the run names")
            hold(is_signed(self.key, self.run, a["records"], a["head"], signature), "the signature of the anchor is wrong")


def record_of(values):
    """The columns of a row, the texts as bytes; None where one cannot be read."""
    r = dict(zip(COLUMNS, values))
    try:
        for k in COLUMNS:
            if k in TEXTS:
                r[k] = r[k].decode() if isinstance(r[k], bytes) else None
            largest = 2**63 if k in ("seq", "mono_ns") else 2**32
            fits = isinstance(r[k], str) if k in TEXTS else isinstance(r[k], int) and 0 <= r[k] < largest
            if not fits and not (k == "command_id" and r[k] is None):
                return None
        return r if r["kind"] in KINDS else None
    except UnicodeDecodeError:
        return None


def opened(folder, scratch, under_way):
    """Opens the database so that nothing is written beside it: a log that nobody writes is read in a copy."""
    database, log = folder / "journal.sqlite", folder / "journal.sqlite-wal"
    if not database.is_file():
        raise Absent("there is no journal.sqlite")
    header = database.open("rb").read(100)
    if header[:16] != b"SQLite format 3\0" or header[68:72] != b"RGrd":
        raise Absent("this is no journal of Regrind")
    if int.from_bytes(header[60:64], "big") not in (1, 2):
        raise Absent("the journal has a layout that is not known here")
    if any(os.path.lexists(beside) and not beside.is_file() for beside in (folder / f"journal.sqlite-{k}" for k in ("wal", "shm", "journal"))):
        raise Absent("what lies beside the database is no file")
    change = folder / "journal.sqlite-journal"
    if not under_way and change.is_file() and change.open("rb").read(1) not in (b"", b"\0"):
        raise Absent("its making was cut off, and nothing in it was committed")
    how = "mode=ro" if under_way else "immutable=1"
    if not under_way and log.exists() and log.stat().st_size:
        for file in (database, log):
            shutil.copy(file, scratch)
        database, how = Path(scratch) / database.name, "mode=rw"
    return sqlite3.connect(f"{database.absolute().as_uri()}?{how}", uri=True)


def check_schema(connection):
    """The tables are those of a record, and nothing else: a view can show anything, and without end."""
    words = lambda sql: " ".join(sql.split())
    found = list(connection.execute("SELECT type, name, sql FROM sqlite_schema"))
    own = lambda kind, name, sql: sql is None and kind == "index" and name.startswith("sqlite_autoindex_record_")
    if not all(own(*one) or one[2] is not None and words(one[2]) in SCHEMA for one in found):
        raise Absent("it has a table, view, index or trigger that a record has not")
    if ("table", "record") not in [one[:2] for one in found]:
        raise Absent("it has no table of records")


def rows_of(connection):
    connection.text_factory = bytes
    texts = lambda k: f"CASE typeof({k}) WHEN 'text' THEN {k} END" if k in TEXTS else k
    return connection.execute(f"SELECT {','.join(map(texts, COLUMNS))} FROM record WHERE seq >= 1 ORDER BY seq")


def lines_of(path):
    """The records of an export, as rows."""
    lines = path.read_bytes().split(b"\n")
    for line in lines if lines[-1] else lines[:-1]:
        try:
            text = line.decode()
            payload = text[text.index(',"payload":') + 11 : text.rindex(',"reason":')]
            r = {**parsed(text), "payload": payload}
            if text != f'{text_of(r)[:-1]},"prev_hash":"{r["prev_hash"]}","hash":"{r["hash"]}"}}':
                raise ValueError
            yield tuple(r[k].encode() if k in TEXTS else r[k] for k in COLUMNS)
        except (ValueError, KeyError, AttributeError, TypeError):
            yield (None,) * len(COLUMNS)


def is_driven(folder):
    try:
        if not (folder / ".lock").is_file():
            return False
        with open(folder / ".lock") as lock:
            fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
        return False
    except BlockingIOError:
        return True
    except OSError:
        return False


def read_anchor(path):
    try:
        anchor = parsed(path.read_text()) if path.is_file() and path.stat().st_size <= 4096 else {}
        texts = all(isinstance(anchor.get(k), (str, type(None))) for k in ("run", "key", "signature"))
        if isinstance(anchor["records"], int) and isinstance(anchor["head"], str) and texts:
            return anchor
    except (ValueError, KeyError, TypeError, AttributeError):
        pass
    raise Broken(0, f"{path.name} is no anchor")


def walk(path, chain, anchors, under_way):
    """Takes every record, and holds them against the anchors; returns up to where these reach."""
    anchored = 0
    with tempfile.TemporaryDirectory() as scratch:
        database = opened(path, scratch, under_way) if path.is_dir() else None
        try:
            if database:
                check_schema(database)
            for row in rows_of(database) if database else lines_of(path):
                chain.take(record_of(row))
                for anchor in anchors:
                    if anchor["records"] == chain.records:
                        chain.take_anchor(anchor)
                        anchored = chain.records
            if chain.records == 0:
                raise Broken(1, "there is no record")
            if any(anchor["records"] > chain.records for anchor in anchors):
                raise Broken(chain.records + 1, "an anchor has more records: the end was cut off")
            if database and any(database.execute("SELECT 1 FROM record WHERE seq < 1 LIMIT 1")):
                raise Broken(0, "a record stands before the first")
        except sqlite3.DatabaseError as error:
            raise Broken(0, f"the database file itself is damaged: {error}")
    return anchored


def verify(path, kept, trusted):
    """Returns the verdict on a run folder or an export."""
    if not path.exists():
        raise Absent("there is no such file or folder")
    folder = path if path.is_dir() else None
    chain, under_way = Chain(folder, trusted), folder is not None and is_driven(path)
    try:
        beside = [path / "journal.anchor"] if folder and (path / "journal.anchor").exists() else []
        anchored = walk(path, chain, [read_anchor(p) for p in beside + kept], under_way)
    except Broken as broken:
        return {"run": str(path), "sound": False, "record": broken.record, "what": broken.what}
    if chain.no_author:
        return {"run": str(path), "sound": False, "record": None, "what": chain.no_author}
    closed = chain.ended is not None
    lacks, is_sealed = None, not chain.keys or chain.signed == chain.ended
    if closed and not is_sealed and (not under_way or trusted):
        lacks = "the end of the record is not signed, although the run has a key"
    elif not anchored and (folder or not closed):
        lacks = "journal.anchor is missing: it is unknown whether the end of the record was cut off"
    elif not closed and not under_way:
        lacks = "the run was interrupted: its program no longer runs, and the record has no end"
    return {
        "run": str(path), "sound": True, "records": chain.records, "head": chain.head, "anchored": anchored, "closed": closed,
        "under_way": under_way, "artefacts": chain.files, "keys": chain.keys, "seals": chain.seals, "signed": chain.signed,
        "lacks": lacks, "whole": not lacks and closed and is_sealed,
    }  # fmt: skip


def in_words(found):
    if not found["sound"] and found["record"] is None:
        return f"{found['run']}: WHOLE, and who wrote it is not proven: {found['what']}"
    if not found["sound"]:
        return f"{found['run']}: BROKEN at record {found['record']}: {found['what']}"
    signed = f"signed up to record {found['signed']} by {', '.join(found['keys'])}" if found["keys"] else "not signed"
    if found["keys"] and Ed25519PublicKey is None:
        signed = "signature NOT CHECKED: python3 has no package `cryptography`"
    end = found["lacks"] or ("closed" if found["whole"] else "under way")
    return f"{found['run']}: sound, {found['records']} records, {found['artefacts']} files, {end}; {signed}\nhead {found['head']}"


def main():
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("runs", nargs="+", type=Path, metavar="RUN")
    options.add_argument("--anchor", action="append", type=Path, default=[], help="copy of journal.anchor that was kept elsewhere")
    options.add_argument("--key", action="append", default=[], help="public key that may have signed, 64 digits")
    options.add_argument("--json", action="store_true", help="a line of JSON for each run")
    given, codes = options.parse_args(), set()
    if not all(is_hex(key, 64) for key in given.key) or not all(anchor.is_file() for anchor in given.anchor):
        options.error("--key takes 64 small hexadecimal digits, --anchor a file")
    if given.key and Ed25519PublicKey is None:
        options.error("--key needs the Python package `cryptography`")
    for run in given.runs:
        try:
            found = verify(run, given.anchor, given.key)
            codes.add(1 if not found["sound"] or found["lacks"] else 0 if found["whole"] else 4)
            print(json.dumps(found) if given.json else in_words(found))
        except Absent as absent:
            codes.add(2)
            print(json.dumps({"run": str(run), "absent": str(absent)}) if given.json else f"{run}: {absent}")
    # The worst of them.
    return next(code for code in (1, 2, 4, 0) if code in codes)


if __name__ == "__main__":
    sys.exit(main())

//! The record: how long a commit takes, and how long a long journal to open, to reconcile and to prove.
//!
//! ```text
//! cargo bench -p regrind-journal -- [RECORDS] [COMMITS]
//! ```
//! By default a million records, a tenth of them commands with their outcomes, every 256 sealed; and 20,000 commits, each on the disk
//! before the next, on the disk that holds the folder for temporary files (TMPDIR). Beside the journal stands what the disk itself takes
//! for as many bytes and a sync.

mod written;

use std::io::Write;
use std::path::Path;
use std::time::{Duration, Instant};

use regrind_journal::{AuditKey, Entry, Journal, Reader, RecordKind, verify};
use serde_json::json;

fn main() {
    // Cargo adds options of its own.
    let mut numbers = std::env::args().skip(1).filter_map(|argument| argument.parse().ok());
    let records = numbers.next().unwrap_or(1_000_000);
    commits(numbers.next().unwrap_or(20_000));
    long(records);
}

/// Measures the time of `count` commits of one record each. For comparison, measures as many writes of 512 bytes to a
/// plain file, each with a sync to the disk. Prints the median, the 99 % and 99.9 % quantiles, and the maximum of both
/// series in ms.
fn commits(count: u64) {
    let home = written::home();
    let folder = home.path().join("run");
    let mut journal = Journal::create_with(&folder, written::header(), Some(AuditKey::new())).unwrap();
    let mut disk = std::fs::File::create(home.path().join("disk")).unwrap();
    let (mut times, mut disk_times) = (Vec::new(), Vec::new());
    for k in 0..count {
        let payload = json!({ "done": k, "event": "progressed", "total": count, "words": "of the path" });
        let entry = Entry::new(RecordKind::Event, k, 1, payload);
        times.push(timed(|| journal.append(entry).unwrap()).1);
        disk_times.push(timed(|| disk.write_all(&[0; 512]).and_then(|()| disk.sync_data()).unwrap()).1);
    }
    println!("{count} commits            p50       p99     p99.9       max  ms");
    for (what, mut times) in [("a record, committed", times), ("512 bytes and a sync", disk_times)] {
        times.sort_unstable();
        let ms = |share: f64| 1e3 * times[((times.len() - 1) as f64 * share) as usize].as_secs_f64();
        println!("{what:22}{:>8.2}{:>10.2}{:>10.2}{:>10.2}", ms(0.5), ms(0.99), ms(0.999), ms(1.0));
    }
}

fn long(records: u64) {
    let (made, took) = timed(|| written::long(records));
    let (home, folder) = made;
    let bytes = std::fs::metadata(folder.join("journal.sqlite")).unwrap().len();
    println!("\n{records} records, {:.0} MB, written in {:.1} s", 1e-6 * bytes as f64, took.as_secs_f64());
    let told = |what: &str, times: &[Duration]| {
        let all: Vec<String> = times.iter().map(|time| format!("{:.2}", time.as_secs_f64())).collect();
        println!("{what:22}{} s", all.join("  "));
    };
    let again = |work: &dyn Fn(&Path)| -> Vec<Duration> { (0..3).map(|_| timed(|| work(&folder)).1).collect() };
    told("verify", &again(&|folder| assert_eq!(verify(folder).unwrap().records, records)));
    told(
        "read every record",
        &again(&|folder| assert_eq!(Reader::open(folder).unwrap().records(1).count() as u64, records)),
    );
    // One that is to be gone on with has no end yet.
    written::tamper(&folder, &format!("DELETE FROM record WHERE seq > {}", records - 2));
    let sql = format!("SELECT json_object('records', seq, 'head', hash) FROM record WHERE seq = {}", records - 300);
    let database = rusqlite::Connection::open(folder.join("journal.sqlite")).unwrap();
    let anchor: String = database.query_row(&sql, [], |row| row.get(0)).unwrap();
    drop(database);
    // The anchor that a run leaves is at most 256 records behind.
    let key = AuditKey::new();
    let mut opened = Vec::new();
    let mut reconciled = Vec::new();
    for _ in 0..3 {
        std::fs::write(folder.join("journal.anchor"), &anchor).unwrap();
        let (journal, took) = timed(|| Journal::open_with(&folder, Some(key.clone())).unwrap());
        opened.push(took);
        reconciled.push(timed(|| journal.open_intents().unwrap()).1);
    }
    told("open to go on", &opened);
    told("what is not answered", &reconciled);
    drop(home);
}

fn timed<T>(work: impl FnOnce() -> T) -> (T, Duration) {
    let began = Instant::now();
    let done = work();
    (done, began.elapsed())
}

//! Damaged samples for every parser of external input. No parser panics, runs for ever, returns a number that is not
//! finite, or allocates the memory that a header claims before the data are there. The bodies are those that cargo-fuzz
//! runs without end.
//!
//! Recipes and cells are damaged in tests/cli/recipe.rs, registers in the module of their driver.

use std::fs;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use peak_alloc::PeakAlloc;
use proptest::prelude::*;
use proptest::sample::Index;
use regrind::compensation::{Correction, ErrorMap, GainRule, LearningState, MapOptions, PassObservation};
use regrind::formats::Learned;
use regrind::geometry::Grid;
use regrind::journal::{Entry, Header, Journal, RecordKind};
use regrind_sim::payload;
use regrind_testcell::payloads::Encode;
use regrind_testparsers as parsers;
use serde_json::json;

#[global_allocator]
static MEMORY: PeakAlloc = PeakAlloc;

/// Memory limit for all tests of this file together, in MB. A parser that trusts a false claim exceeds it.
const MAX_MEMORY_MB: f64 = 400.0;

/// Returns the samples of a parser, in the order of their names.
fn samples(parser: &str) -> Vec<(PathBuf, Vec<u8>)> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz/corpus").join(parser);
    let mut paths: Vec<_> = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
    paths.sort();
    paths.into_iter().map(|path| (path.clone(), fs::read(path).unwrap())).collect()
}

/// Damage to a file.
#[derive(Clone, Debug)]
enum Damage {
    Flip(Index, u8),
    Cut(Index),
    Remove(Index, usize),
    Repeat(Index, usize, usize),
    Insert(Index, Vec<u8>),
    /// A run of digits becomes another number.
    Number(Index, &'static str),
}

const NUMBERS: [&str; 14] = [
    "0",
    "-1",
    "1",
    "2",
    "255",
    "65536",
    "4000000000",
    "-2147483648",
    "18446744073709551616",
    "1e308",
    "-1e-320",
    "nan",
    "inf",
    "1e6",
];

fn damage() -> impl Strategy<Value = Damage> {
    let bytes = prop_oneof![
        prop::collection::vec(any::<u8>(), 1..9),
        prop::collection::vec(
            prop::sample::select(b"0123456789.,;:-+eE#%()[]{}<>\"'\\/ \t\r\n=xyznaif\0\xff".to_vec()),
            1..9
        ),
    ];
    prop_oneof![
        (any::<Index>(), 0u8..8).prop_map(|(at, bit)| Damage::Flip(at, bit)),
        any::<Index>().prop_map(Damage::Cut),
        (any::<Index>(), 1usize..20).prop_map(|(at, length)| Damage::Remove(at, length)),
        (any::<Index>(), 1usize..40, 1usize..50).prop_map(|(at, length, times)| Damage::Repeat(at, length, times)),
        (any::<Index>(), bytes).prop_map(|(at, with)| Damage::Insert(at, with)),
        (any::<Index>(), prop::sample::select(NUMBERS.to_vec())).prop_map(|(at, with)| Damage::Number(at, with)),
    ]
}

impl Damage {
    fn to(&self, bytes: &mut Vec<u8>) {
        let length = bytes.len();
        if length == 0 {
            return;
        }
        match self {
            Self::Flip(at, bit) => bytes[at.index(length)] ^= 1 << bit,
            Self::Cut(at) => bytes.truncate(at.index(length)),
            Self::Remove(at, count) => drop(bytes.drain(at.index(length)..length.min(at.index(length) + count))),
            Self::Repeat(at, count, times) => {
                let (from, to) = (at.index(length), length.min(at.index(length) + count));
                let again = bytes[from..to].repeat(*times);
                bytes.splice(to..to, again);
            }
            Self::Insert(at, with) => drop(bytes.splice(at.index(length)..at.index(length), with.iter().copied())),
            Self::Number(at, with) => {
                let numeric = |b: &u8| b.is_ascii_digit() || b"+-.".contains(b);
                let Some(from) = (at.index(length)..length).find(|&k| numeric(&bytes[k])) else { return };
                let to = from + bytes[from..].iter().take_while(|b| numeric(b)).count();
                bytes.splice(from..to, with.bytes());
            }
        }
    }
}

/// Returns the number of mutants of one parser: `usual`, or the one that the long run asks for.
fn cases(usual: u32) -> u32 {
    std::env::var("REGRIND_MUTANTS").ok().map_or(usual, |count| count.parse().expect("REGRIND_MUTANTS is a number"))
}

/// Longest time for one mutant. A parser that hangs takes longer, on any machine.
const MAX_TIME: Duration = Duration::from_secs(10);

/// Time that this thread has had a processor, so that other programs do not count. Where the system does not tell it, time
/// by the clock.
struct ProcessorTime {
    began: Instant,
    before: Option<Duration>,
}

impl ProcessorTime {
    fn start() -> Self {
        Self { began: Instant::now(), before: Self::so_far() }
    }

    fn elapsed(&self) -> Duration {
        let since = |before| Self::so_far().map(|now: Duration| now.saturating_sub(before));
        self.before.and_then(since).unwrap_or_else(|| self.began.elapsed())
    }

    /// Returns the time of this thread on a processor, from Linux.
    fn so_far() -> Option<Duration> {
        let told = fs::read_to_string("/proc/thread-self/schedstat").ok()?;
        told.split_whitespace().next()?.parse().ok().map(Duration::from_nanos)
    }
}

/// The time of a thread grows while it computes, and its limit can be exceeded.
#[test]
fn processor_time_counts_computing() {
    let time = ProcessorTime::start();
    let mut sum = 0_u64;
    while time.elapsed() < Duration::from_millis(20) {
        sum = (0..10_000_u64).fold(sum, |sum, k| std::hint::black_box(sum.wrapping_add(k)));
    }
    assert!(time.began.elapsed() >= Duration::from_millis(19), "{sum}");
}

macro_rules! survives {
    ($($parser:ident $cases:literal),* $(,)?) => {
        $(proptest! {
            #![proptest_config(ProptestConfig { cases: cases($cases), failure_persistence: None, ..ProptestConfig::default() })]

            #[test]
            fn $parser(
                which in any::<Index>(),
                damage in prop::collection::vec(damage(), 0..5),
                noise in prop::collection::vec(any::<u8>(), 0..200),
            ) {
                let samples = samples(stringify!($parser));
                let mut bytes = samples[which.index(samples.len())].1.clone();
                damage.iter().for_each(|damage| damage.to(&mut bytes));
                let time = ProcessorTime::start();
                parsers::$parser(&bytes);
                parsers::$parser(&noise);
                prop_assert!(time.elapsed() < MAX_TIME, "{:?}", time.elapsed());
                prop_assert!(MEMORY.peak_usage_as_mb() < MAX_MEMORY_MB as f32, "{} MB", MEMORY.peak_usage_as_mb());
            }
        })*

        /// Parses each sample, which succeeds unless it claims data that are not there, and each of its truncations.
        #[test]
        fn samples_and_truncations_parse() {
            let mut wrong = Vec::new();
            $(for (path, sample) in samples(stringify!($parser)) {
                let claims = path.file_name().unwrap().to_string_lossy().starts_with("claims_");
                if parsers::$parser(&sample) == claims {
                    wrong.push(path.clone());
                }
                let step = sample.len().div_ceil(64).max(1);
                for end in (0..sample.len()).step_by(step) {
                    parsers::$parser(&sample[..end]);
                }
            })*
            assert!(wrong.is_empty(), "{wrong:?}");
            assert!(MEMORY.peak_usage_as_mb() < MAX_MEMORY_MB as f32, "{} MB", MEMORY.peak_usage_as_mb());
        }
    };
}

survives! {
    anchor 256, cad 256, content 1024, definition 2048, event 1024, journal 256, learned 1024, lens 512, map 1024, metropro 1024, order 2048, payload 2048, ply 2048, points 2048,
    program 512, program_map 512, record 1024, references 2048, result 2048, sdf 2048, stl 2048, x3p 1024, x3p_document 1024,
}

/// Checks that unlimited nesting is refused before the stack overflows.
#[test]
fn parsers_survive_deep_nesting() {
    for (open, inner, close) in [
        ("[", "", "]"),
        ("{\"a\":", "1", "}"),
        ("{a=", "1", "}"),
        ("<a>", "", "</a>"),
        ("- ", "1", ""),
        ("(", "", ")"),
        ("a.", "a", ""),
    ] {
        for times in [100, 3000, 20_000] {
            let nested = format!("{}{inner}{}", open.repeat(times), close.repeat(times));
            for text in [nested.clone(), format!("a = {nested}\n"), format!("{nested} = 1\n"), format!("[{nested}]\n")]
            {
                let parsers: [fn(&[u8]) -> bool; 16] = [
                    parsers::anchor,
                    parsers::cad,
                    parsers::cell,
                    parsers::content,
                    parsers::definition,
                    parsers::event,
                    parsers::learned,
                    parsers::lens,
                    parsers::order,
                    parsers::points,
                    parsers::program,
                    parsers::recipe,
                    parsers::record,
                    parsers::references,
                    parsers::result,
                    parsers::x3p_document,
                ];
                for parser in parsers {
                    parser(text.as_bytes());
                }
            }
        }
    }
}

/// Writes the samples that are generated from types. Run it after a change to one of these types.
#[test]
#[ignore = "writes into fuzz/corpus"]
fn samples_are_made() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz/corpus");
    let save = |parser: &str, name: &str, bytes: &[u8]| {
        fs::create_dir_all(folder.join(parser)).unwrap();
        fs::write(folder.join(parser).join(name), bytes).unwrap();
    };
    let lines = |values: Vec<serde_json::Value>| values.iter().map(|value| format!("{value}\n")).collect::<String>();
    let events = regrind::cell::sample_events(1).iter().map(|event| serde_json::to_value(event).unwrap()).collect();
    save("event", "events.jsonl", lines(events).as_bytes());
    for (name, content) in small_run() {
        fs::create_dir_all(folder.join("../journal")).unwrap();
        fs::write(folder.join("../journal").join(name), &content).unwrap();
        if name == "journal.anchor" {
            save("anchor", name, &content);
        }
    }
    save("learned", "learned.json", &serde_json::to_vec(&what_was_learned()).unwrap());
    let targets = vec![payload::Target {
        index: 9,
        feature: payload::Feature::Part,
        point_mm: [1.0, -2.0, 0.5],
        normal: [0.0, 0.0, 1.0],
    }];
    let plan = payload::Plan {
        probe_radius_mm: 2.0,
        approach_mm: 1.0,
        search_mm: 0.5,
        speed_mm_s: 4.0,
        safe_height_mm: 8.0,
        careful: (1, 2.0),
        targets,
    };
    let map = payload::Map {
        columns: 3,
        rows: 2,
        first_mm: [-1.0, -2.0],
        spacing_mm: [2.0, 4.0],
        nominal: [0xab; 32],
        values_mm: vec![0.0, 0.5, -0.25, 0.0, 0.0, 1.0],
    };
    let pass = payload::Pass {
        spark_out: 2,
        wheel_radius_mm: 10.0,
        feed_mm_min: 200.0,
        track_spacing_mm: 0.5,
        level_mm: 0.0,
        depth_of_cut_mm: 0.5,
        extent_mm: [-1.0, 1.0, -2.0, 2.0],
        nominal: [0xcd; 32],
    };
    let record = payload::PassRecord {
        job: 7,
        cycle: 2,
        result: 1,
        path_mm: 100.0,
        volume_mm3: 2.0,
        depth_mm: 0.05,
        air_share: 0.2,
        spindle_load: 0.4,
        wheel_radius_mm: 10.0,
    };
    let points = [1, 2].map(|index| payload::PointRecord {
        index,
        status: payload::Status::Touched,
        quality: 5,
        position_mm: [1.5, -2.5, 3.5],
    });
    let kinds = [
        ("plan", plan.encode()),
        ("map", map.encode()),
        ("pass", pass.encode()),
        ("record", record.encode()),
        ("points", payload::encode_points(&points, None)),
        ("short_points", payload::encode_points(&points, Some(1e-6))),
    ];
    for (kind, (name, bytes)) in (0..).zip(kinds) {
        save("payload", name, &[&[kind], &bytes[..]].concat());
    }
}

/// Returns the journal and anchor of a small run that finished.
fn small_run() -> [(&'static str, Vec<u8>); 2] {
    let home = tempfile::tempdir().unwrap();
    let run = home.path().join("run");
    let header = Header {
        run: "run".into(),
        part: "SN 7".into(),
        actor: "Ada".into(),
        station: "console".into(),
        simulation: true,
        first_command_id: 1,
        content: json!({ "recipe": "abc" }),
    };
    let mut journal = Journal::create(&run, header).unwrap();
    let intent = journal.intend(Entry::new(RecordKind::Intent, 5, 1, json!({ "command": "register" }))).unwrap();
    let outcome = Entry { command_id: Some(intent), ..Entry::new(RecordKind::Outcome, 6, 1, json!({ "z": 1.5 })) };
    journal.append(outcome).unwrap();
    journal.store("measured.csv", b"1,2,3\n", 7, 1).unwrap();
    journal.close(9, 1, json!("accepted")).unwrap();
    assert!(!run.join("journal.sqlite-wal").exists(), "all of it lies in one file");
    ["journal.sqlite", "journal.anchor"].map(|name| (name, fs::read(run.join(name)).unwrap()))
}

/// Returns the knowledge that a run has learned of a grinder, on a small grid.
fn what_was_learned() -> Learned {
    let grid = Grid { columns: 5, rows: 4, first_mm: [-2.0, -1.5], spacing_mm: [1.0, 1.0] };
    let correction = Correction::zero(grid, 0.05);
    let error = ErrorMap::exact(grid, (0..grid.len()).map(|k| 1e-3 * k as f64).collect(), vec![true; grid.len()]);
    let begin = LearningState::new(GainRule::Wavelength, &MapOptions::new(1.0, 1.0), [4.0, 3.0], None);
    let known =
        begin.updated(&PassObservation { correction: &correction, error: &error, response: None, explained: None });
    Learned::new(true, "a part".into(), "run-1".into(), correction.compensating(&known, None), known)
}

//! The payloads byte by byte, as docs/modbus.md lays them out, and what is wrong with wrong ones.

use regrind_sim::payload::{Feature, Map, Pass, PassRecord, Plan, PointRecord, Status, Target, encode_points};
use regrind_testsim::payloads::{Encode, decode_pass_record, decode_points};

const ONE: [u8; 8] = [0x3f, 0xf0, 0, 0, 0, 0, 0, 0];
const ONE_AND_A_HALF: [u8; 8] = [0x3f, 0xf8, 0, 0, 0, 0, 0, 0];
const TWO: [u8; 8] = [0x40, 0, 0, 0, 0, 0, 0, 0];
const MINUS_TWO: [u8; 8] = [0xc0, 0, 0, 0, 0, 0, 0, 0];
const ZERO: [u8; 8] = [0; 8];

fn plan() -> (Plan, Vec<u8>) {
    let target = Target {
        index: 0x0102_0304,
        feature: Feature::ReferenceSphere,
        point_mm: [1.0, -2.0, 1.5],
        normal: [0.0, 0.0, 1.0],
    };
    let plan = Plan {
        probe_radius_mm: 1.5,
        approach_mm: 2.0,
        search_mm: 1.0,
        speed_mm_s: 2.0,
        safe_height_mm: 0.0,
        careful: (0, 0.0),
        targets: vec![target],
    };
    let mut bytes = vec![0, 1, 0, 0, 0, 0, 0, 1];
    bytes.extend([ONE_AND_A_HALF, TWO, ONE, TWO, ZERO, ZERO, ZERO].concat());
    bytes.extend([1, 2, 3, 4, 0, 2, 0, 0]);
    bytes.extend([ONE, MINUS_TWO, ONE_AND_A_HALF, ZERO, ZERO, ONE].concat());
    (plan, bytes)
}

fn map() -> (Map, Vec<u8>) {
    let map = Map {
        columns: 3,
        rows: 2,
        first_mm: [-2.0, 0.0],
        spacing_mm: [1.0, 2.0],
        nominal: [0xab; 32],
        values_mm: vec![1.0, 0.0, -2.0, 0.0, 1.5, 0.0],
    };
    let mut bytes = vec![0, 1, 0, 1, 0, 0, 0, 3, 0, 0, 0, 2, 0, 0, 0, 0];
    bytes.extend([MINUS_TWO, ZERO, ONE, TWO, TWO, ZERO].concat());
    bytes.extend([0xab; 32]);
    bytes.extend([ONE, ZERO, MINUS_TWO, ZERO, ONE_AND_A_HALF, ZERO].concat());
    (map, bytes)
}

fn pass() -> (Pass, Vec<u8>) {
    let pass = Pass {
        spark_out: 3,
        wheel_radius_mm: 1.5,
        feed_mm_min: 2.0,
        track_spacing_mm: 1.0,
        level_mm: -2.0,
        depth_of_cut_mm: 1.0,
        extent_mm: [-2.0, 2.0, 0.0, 1.0],
        nominal: [0xcd; 32],
    };
    let mut bytes = vec![0, 1, 0, 3, 0, 0, 0, 0];
    bytes.extend([ONE_AND_A_HALF, TWO, ONE, MINUS_TWO, ONE].concat());
    bytes.extend([MINUS_TWO, TWO, ZERO, ONE, ZERO, ZERO].concat());
    bytes.extend([0xcd; 32]);
    (pass, bytes)
}

/// Returns the bytes with some of them replaced.
fn with(bytes: &[u8], at: usize, by: &[u8]) -> Vec<u8> {
    let mut bytes = bytes.to_vec();
    bytes[at..at + by.len()].copy_from_slice(by);
    bytes
}

#[test]
fn inbound_payload_byte_layout() {
    let (value, bytes) = plan();
    assert_eq!((bytes.len(), value.encode()), (64 + 56, bytes.clone()));
    assert_eq!(Plan::decode(&bytes), Ok(value));
    let (value, bytes) = map();
    assert_eq!((bytes.len(), value.encode()), (96 + 48, bytes.clone()));
    assert_eq!(Map::decode(&bytes), Ok(value));
    let (value, bytes) = pass();
    assert_eq!((bytes.len(), value.encode()), (128, bytes.clone()));
    assert_eq!(Pass::decode(&bytes), Ok(value));
}

#[test]
fn point_record_byte_layout() {
    let records = [
        PointRecord { index: 0x0102_0304, status: Status::Touched, quality: 7, position_mm: [1.0, -2.0, 1.5] },
        PointRecord { index: 5, status: Status::NotFound, quality: 100, position_mm: [0.0; 3] },
        PointRecord { index: 6, status: Status::NotReached, quality: 100, position_mm: [0.0; 3] },
    ];
    let mut plain = vec![1, 2, 3, 4, 0, 1, 0, 7];
    plain.extend([ONE, MINUS_TWO, ONE_AND_A_HALF].concat());
    plain.extend([0, 0, 0, 5, 0, 2, 0, 100]);
    plain.extend([0; 24]);
    plain.extend([0, 0, 0, 6, 0, 3, 0, 100]);
    plain.extend([0; 24]);
    assert_eq!(encode_points(&records, None), plain);
    assert_eq!(decode_points(&plain, None).unwrap(), records);
    let counts = encode_points(&records[..1], Some(0.5));
    assert_eq!(counts, [1, 2, 3, 4, 0, 1, 0, 7, 0, 0, 0, 2, 0xff, 0xff, 0xff, 0xfc, 0, 0, 0, 3]);
    assert_eq!(decode_points(&counts, Some(0.5)).unwrap(), records[..1]);
    assert_eq!(decode_points(&plain[..31], None), None);
}

#[test]
fn pass_record_byte_layout() {
    let record = PassRecord {
        job: 0x0102_0304,
        cycle: 0x0506,
        result: 2,
        path_mm: 1.0,
        volume_mm3: 2.0,
        depth_mm: 1.5,
        air_share: 1.0,
        spindle_load: 0.0,
        wheel_radius_mm: -2.0,
    };
    let mut bytes = vec![1, 2, 3, 4, 5, 6, 0, 2];
    bytes.extend([ONE, TWO, ONE_AND_A_HALF, ONE, ZERO, MINUS_TWO, ZERO].concat());
    assert_eq!((bytes.len(), record.encode()), (64, bytes.clone()));
    assert_eq!(decode_pass_record(&bytes), Some(record));
}

#[test]
fn payload_refuses_truncation() {
    let (plan, map, pass) = (plan().1, map().1, pass().1);
    for end in 0..plan.len() {
        assert_eq!(Plan::decode(&plan[..end]).unwrap_err().answer, 8, "plan of {end} bytes");
    }
    for end in 0..map.len() {
        assert_eq!(Map::decode(&map[..end]).unwrap_err().answer, 8, "map of {end} bytes");
    }
    for end in 0..pass.len() {
        assert_eq!(Pass::decode(&pass[..end]).unwrap_err().answer, 8, "pass of {end} bytes");
    }
    for mut longer in [plan, map, pass] {
        longer.push(0);
        assert!(Plan::decode(&longer).is_err() && Map::decode(&longer).is_err() && Pass::decode(&longer).is_err());
    }
}

#[test]
fn plan_decode_names_reason() {
    let bytes = plan().1;
    let nan = f64::NAN.to_be_bytes();
    let cases: [(usize, &[u8], u16, &str); 16] = [
        (0, &[0, 2], 8, "format is 2"),
        (2, &[0, 1], 8, "reserved"),
        (4, &[0, 0, 0, 2], 8, "2 records make 176"),
        (4, &[0xff; 4], 8, "4294967295 records"),
        (8, &nan, 8, "not finite"),
        (8, &ZERO, 10, "probe radius"),
        (16, &MINUS_TWO, 10, "approach"),
        (32, &f64::INFINITY.to_be_bytes(), 8, "not finite"),
        (48, &[0, 0, 0, 2], 10, "number of careful targets"),
        (52, &[1], 8, "reserved"),
        (56, &ONE, 10, "careful speed"),
        (68, &[0, 3], 8, "is on 3"),
        (70, &[0, 1], 8, "reserved"),
        (72, &nan, 8, "point"),
        (112, &TWO, 8, "length 2"),
        (112, &ZERO, 8, "length 0"),
    ];
    for (at, by, answer, reason) in cases {
        let refusal = Plan::decode(&with(&bytes, at, by)).unwrap_err();
        assert!(refusal.answer == answer && refusal.reason.contains(reason), "{reason}: {refusal}");
    }
    let none = with(&bytes[..64], 4, &[0; 4]);
    assert_eq!(Plan::decode(&none).unwrap_err().answer, 10, "a plan without targets");
    let huge = with(&bytes, 96, &f64::MAX.to_be_bytes());
    assert_eq!(Plan::decode(&huge).unwrap_err().answer, 8, "a normal whose square overflows");
}

#[test]
fn map_decode_names_reason() {
    let bytes = map().1;
    let nan = f64::NAN.to_be_bytes();
    let cases: [(usize, &[u8], u16, &str); 12] = [
        (0, &[0, 0], 8, "format is 0"),
        (2, &[0, 2], 8, "sign is 2"),
        (4, &[0xff; 4], 10, "number of nodes"),
        (4, &[0xff; 8], 10, "number of nodes"),
        (4, &[0, 0, 0, 4], 8, "8 records"),
        (4, &[0, 0, 0, 1], 8, "spans no area"),
        (12, &[0, 0, 0, 1], 8, "reserved"),
        (16, &nan, 8, "not finite"),
        (32, &ZERO, 8, "spacing"),
        (48, &ONE, 8, "largest value is 2"),
        (63, &[1], 8, "reserved"),
        (136, &nan, 8, "a node of the map"),
    ];
    for (at, by, answer, reason) in cases {
        let refusal = Map::decode(&with(&bytes, at, by)).unwrap_err();
        assert!(refusal.answer == answer && refusal.reason.contains(reason), "{reason}: {refusal}");
    }
}

#[test]
fn pass_decode_names_reason() {
    let bytes = pass().1;
    let cases: [(usize, &[u8], u16, &str); 10] = [
        (0, &[1, 0], 8, "format is 256"),
        (2, &[0xff, 0xff], 10, "spark-out"),
        (4, &[1], 8, "reserved"),
        (8, &ZERO, 10, "wheel radius"),
        (16, &MINUS_TWO, 10, "feed"),
        (24, &ZERO, 10, "track spacing"),
        (32, &f64::NAN.to_be_bytes(), 8, "not finite"),
        (40, &ZERO, 10, "depth of cut"),
        (56, &MINUS_TWO, 8, "extent"),
        (95, &[1], 8, "reserved"),
    ];
    for (at, by, answer, reason) in cases {
        let refusal = Pass::decode(&with(&bytes, at, by)).unwrap_err();
        assert!(refusal.answer == answer && refusal.reason.contains(reason), "{reason}: {refusal}");
    }
}

#[test]
fn payload_decode_never_panics() {
    use rand::RngExt;
    const SEED: u64 = 20;
    let mut rng = regrind_sim::rng(SEED);
    let originals = [plan().1, map().1, pass().1];
    for round in 0..20_000 {
        let mut bytes = originals[round % 3].clone();
        for _ in 0..rng.random_range(1..6) {
            let at = rng.random_range(0..bytes.len());
            bytes[at] = rng.random();
        }
        bytes.truncate(rng.random_range(0..=bytes.len() * 8).max(1));
        if let Ok(map) = Map::decode(&bytes) {
            let value = map.displacement_at(rng.random_range(-1e3..1e3), rng.random_range(-1e3..1e3));
            assert!(value.abs() <= map.max_abs_mm() * (1.0 + 1e-12), "seed {SEED}, round {round}: {value}");
        }
        let finite = |plan: Plan| plan.targets.iter().all(|t| t.normal.iter().all(|c| c.is_finite()));
        assert!(Plan::decode(&bytes).map_or(true, finite), "seed {SEED}, round {round}");
        let _ = Pass::decode(&bytes);
    }
}

#[test]
fn map_bilinear_inside_flat_outside() {
    let map = map().0;
    let cases = [
        ([-2.0, 0.0], 1.0),
        ([-1.5, 0.0], 0.5),
        ([0.0, 0.0], -2.0),
        ([-1.0, 2.0], 1.5),
        ([-1.0, 1.0], 0.75),
        ([-0.5, 1.0], -0.125),
        ([-9.0, -9.0], 1.0),
        ([9.0, -1.0], -2.0),
        ([9.0, 1.0], -1.0),
        ([-1.0, 1e300], 1.5),
    ];
    for ([x, y], value) in cases {
        assert_eq!(map.displacement_at(x, y), value, "({x}, {y})");
    }
}

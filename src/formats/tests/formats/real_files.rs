//! Files that others made: X3P, SDF and MetroPro maps, and the exports of a laser tracker.

use regrind_core::geometry::Point;
use regrind_formats::{FormatError, X3pFile, read_measured, read_metropro, read_sdf, read_x3p};
use regrind_testutils::data::data;

fn is_about(found: f64, expected: f64) -> bool {
    (found - expected).abs() <= 1e-12 * expected.abs()
}

/// A file, and what its map holds: columns and rows, spacing, measured samples, a sample as (column, row, height),
/// least and largest height; mm.
type Known = (&'static str, [usize; 2], [f64; 2], usize, (usize, usize, f64), [f64; 2]);

#[rustfmt::skip]
const KNOWN: [Known; 8] = [
    ("openfmc/ISO5436-sample1.x3p", [4, 4], [16.016; 2], 15, (0, 0, 486.219120804151), [-808.368571682830, 1047.59602566142]),
    ("openfmc/ISO5436-sample1_bin.x3p", [4, 4], [16.016; 2], 15, (3, 3, -215.696638464903), [-808.368571682830, 1047.59602566142]),
    // 16-bit integers of 1 mm, from -500 mm on.
    ("openfmc/ISO5436-sample4.x3p", [4, 4], [16.016; 2], 15, (1, 2, 798.0), [-808.0, 1048.0]),
    ("openfmc/ISO5436-sample4_bin.x3p", [4, 4], [16.016; 2], 15, (1, 2, 798.0), [-808.0, 1048.0]),
    // A real measurement; infinity where nothing was seen, its sum in capital letters.
    ("openfmc/KautschukInfiniteFocus.x3p", [860, 634], [0.002279984215, 0.002279794519], 539_944, (0, 0, f64::NAN), [-9.590286936145276e-3, 1.6094123566290364e-2]),
    // An en dash in the revision, dates and types that are none.
    ("x3ptools/pyramid.x3p", [5, 5], [1000.0; 2], 25, (1, 1, 6000.0), [2000.0, 10_000.0]),
    ("x3ptools/testing.x3p", [30, 20], [27.4999996026357; 2], 600, (0, 0, f64::NAN), [-23.818902671337128, 8.962339721620083]),
    // In a folder of its own beside what macOS left there; the first row is the uppermost one.
    ("x3ptools/sample-land.x3p", [918, 256], [0.00258; 2], 209_716, (0, 255, -0.05421108289738186), [-7.947348058223724e-2, 5.249858077149838e-2]),
];

#[test]
#[ignore = "needs real measurements: REGRIND_DATA"]
fn real_x3p_maps_are_read() {
    let folder = data("x3p-sdf-samples");
    for (file, size, spacing_mm, samples, (column, row, height), range_mm) in KNOWN {
        let X3pFile::Map(map) = read_x3p(folder.join(file)).unwrap() else { panic!("{file} is a map") };
        assert_eq!(
            ([map.heights.grid.columns, map.heights.grid.rows], map.measured_count()),
            (size, samples),
            "{file}"
        );
        assert!(
            (0..2).all(|k| is_about(map.heights.grid.spacing_mm[k], spacing_mm[k])),
            "{file}: {:?}",
            map.heights.grid.spacing_mm
        );
        let measured = map.points();
        let (low, high) = measured.iter().fold((f64::MAX, f64::MIN), |(l, h), p| (l.min(p.z), h.max(p.z)));
        assert!(is_about(low, range_mm[0]) && is_about(high, range_mm[1]), "{file}: {low} {high}");
        let found = map.heights.values_mm[row * map.heights.grid.columns + column];
        assert!(height.is_nan() || (found / height - 1.0).abs() < 1e-8, "{file}: {found}");
        assert_eq!(read_measured(folder.join(file)).unwrap(), measured);
        assert_eq!(map.notes.is_empty(), !file.contains("sample-land"), "{file}: {:?}", map.notes);
    }
}

#[test]
#[ignore = "needs real measurements: REGRIND_DATA"]
fn real_x3p_lists_and_irregular_grids() {
    let folder = data("x3p-sdf-samples/openfmc");
    for (file, count, first, last) in [
        ("ISO5436-sample2.x3p", 16, [100.0, 2000.0, 2486.219120804151], [100.003, 2000.003, 1784.303361535097]),
        // y by 16-bit integers of 2 m, from 1 m on.
        ("ISO5436-sample3.x3p", 15, [100.0, 3000.0, 2486.219120804151], [148.048, 9000.0, 1784.303361535097]),
    ] {
        let X3pFile::Points(points) = read_x3p(folder.join(file)).unwrap() else { panic!("{file} is no map") };
        assert_eq!(points.len(), count, "{file}");
        for (found, expected) in [(points[0], first), (points[count - 1], last)] {
            assert!((0..3).all(|k| is_about(found[k], expected[k])), "{file}: {found} not {expected:?}");
        }
    }
}

#[test]
#[ignore = "needs real measurements: REGRIND_DATA"]
fn real_x3p_with_bad_checksum() {
    let folder = data("x3p-sdf-samples/x3ptools");
    // Its main.xml was changed after it was sealed.
    let told = read_x3p(folder.join("csafe-logo.x3p")).unwrap_err();
    assert!(matches!(&told, FormatError::Checksum { entry, .. } if entry == "main.xml"), "{told}");
    assert!(told.to_string().contains("its MD5 is 478a53a5eba1607c2c1f5e4acce01cfb, expected 51f0b43f"), "{told}");
}

#[test]
#[ignore = "needs real measurements: REGRIND_DATA"]
fn real_zygo_maps_match_published() {
    let folder = data("zygo-metropro-dat");
    for (file, size, measured, pitch_mm, pv_nm, rms_nm) in [
        ("prysm_valid_zygo_dat_file.dat", [425, 432], 136_359, 0.11792420264100656, 330.700, 44.591),
        ("surfacetopography_metropro-1.dat", [640, 480], 307_200, 1.0982520279867458e-3, 1363.06, 75.2882),
    ] {
        let map = read_metropro(folder.join(file)).unwrap();
        let [pv, rms] = [1e6 * map.pv_mm(), 1e6 * map.rms_mm()];
        println!(
            "{file}: PV {pv:.3} nm, RMS {rms:.4} nm, {} of {} measured",
            map.measured_count(),
            map.heights.valid.len()
        );
        assert_eq!(
            ([map.heights.grid.columns, map.heights.grid.rows], map.measured_count()),
            (size, measured),
            "{file}"
        );
        assert!((pv - pv_nm).abs() < 5e-3 && (rms - rms_nm).abs() < 5e-4, "{file}: {pv} {rms}");
        assert!(
            map.heights.grid.spacing_mm.iter().all(|spacing| is_about(*spacing, pitch_mm)),
            "{file}: {:?}",
            map.heights.grid.spacing_mm
        );
        assert_eq!(read_measured(folder.join(file)).unwrap().len(), measured);
    }
}

#[test]
#[ignore = "needs real measurements: REGRIND_DATA"]
fn real_sdf_softgauge_is_read() {
    let folder = data("x3p-sdf-samples");
    for file in ["surfacetopography/sdf-1.sdf", "surfalize/test_ascii.sdf"] {
        let map = read_sdf(folder.join(file)).unwrap();
        assert_eq!(([map.heights.grid.columns, map.heights.grid.rows], map.measured_count()), ([7, 4], 28), "{file}");
        assert!(map.heights.grid.spacing_mm.iter().all(|spacing| is_about(*spacing, 1e-3)));
        for (k, height) in [(0, 1e-3), (12, 0.96736e-3), (27, 0.97986e-3)] {
            assert!(is_about(map.heights.values_mm[k], height), "{file}: {}", map.heights.values_mm[k]);
        }
    }
    // Gridded points as text are points like any others; the one that is NaN is refused.
    for (file, points) in [("xyz-1.txt", 16), ("xyz-1-different-order.txt", 16)] {
        assert_eq!(read_measured(folder.join("surfacetopography").join(file)).unwrap().len(), points, "{file}");
    }
    let told = read_measured(folder.join("surfacetopography/xyz-2.txt")).unwrap_err();
    assert!(matches!(told, FormatError::NotFinite { .. }), "{told}");
}

#[test]
#[ignore = "needs real measurements: REGRIND_DATA"]
fn real_tracker_exports_are_read() {
    let data = data("lat-freeform-mirror");
    let stations = (1..=7).map(|i| read_measured(data.join("20250824_M1_1").join(format!("M1_{i}.txt"))).unwrap());
    let points: Vec<Point> = stations.flatten().collect();
    assert!(points.len() > 1000);
    assert_eq!(points[0], Point::new(2512.1218, 2217.6752, 2370.7970));
    let result = read_measured(data.join("20250824_M1_1").join("M1_Tracker_20250824_1_surface.txt")).unwrap();
    assert_eq!(result[0].x, 2_496.209_650_820_596_4);
    assert!(read_measured(data.join("20250825_M1/M1_Tracker_20250825_part2_to_hit.csv")).is_err());
}

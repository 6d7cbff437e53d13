//! One function for every parser of what comes from outside: it gives the parser any bytes, and holds what comes out
//! against what may come out. An error is fine; a panic is not, nor is a number that is none. Each returns whether
//! something was read.
//!
//! `fuzz/fuzz_targets` gives them what libFuzzer thinks of, `tests/parsers.rs` a bounded number of damaged samples.

use std::fs;
use std::io::{Cursor, Write};
use std::path::Path;

use regrind::cell::{Command, Ending, Event, Judgement};
use regrind::compensation::Correction;
use regrind::compensation::path::{HeightField, TargetSurface};
use regrind::config::{CellConfig, read_named_dialect};
use regrind::device::file_exchange::ResultRequirements;
use regrind::document::Problems;
use regrind::drive::{Reply, Request};
use regrind::formats::Unit;
use regrind::formats::gcode::{
    AlongNormals, Amendment, MapBase, MapKind, ProgramMap, correct_program, read_program_map,
};
use regrind::formats::result::{Content, Coordinates, DecimalMark, check_ended, parse_result};
use regrind::formats::{
    HeightMap, LIMIT_MM, Learned, X3pFile, parse_cad, parse_lens, parse_map, parse_metropro, parse_ply, parse_points,
    parse_scanner_cloud, parse_sdf, parse_stl, parse_x3p, read_error_map, references::parse_references,
};
use regrind::geometry::{Grid, GridMap, Point};
use regrind::journal::{Anchor, Reader, RecordKind, canonical_json, verify};
use regrind::recipe::Recipe;
use regrind::surface::DefinedSurface;
use regrind::surface::analytic::Sampling;
use regrind::surface::parametric::FaceFrame;
use regrind_sim::payload;
use regrind_testcell::payloads::{self, Encode};
use regrind_testutils::root;
use serde::{Serialize, de::DeserializeOwned};
use serde_json::Value;
use tempfile::TempDir;

fn path() -> &'static Path {
    Path::new("any.file")
}

fn assert_believable(points: &[Point]) {
    assert!(points.iter().all(|p| p.iter().all(|v| v.abs() <= LIMIT_MM)));
}

// ---- points, meshes, maps -----------------------------------------------------------------------------------------------------------

/// Points as text.
pub fn points(bytes: &[u8]) -> bool {
    let Ok(points) = parse_points(path(), bytes) else { return false };
    assert_believable(&points);
    assert!(!points.is_empty() && points.len() <= bytes.len());
    true
}

/// Points and meshes in PLY.
pub fn ply(bytes: &[u8]) -> bool {
    let Ok(file) = parse_ply(path(), bytes) else { return false };
    assert_believable(&file.points);
    assert_corners(&file.triangles, file.points.len());
    true
}

/// Meshes in STL.
pub fn stl(bytes: &[u8]) -> bool {
    let Ok(file) = parse_stl(path(), bytes) else { return false };
    assert_believable(&file.points);
    assert_corners(&file.triangles, file.points.len());
    true
}

fn assert_corners(triangles: &[[u32; 3]], points: usize) {
    assert!(triangles.iter().flatten().all(|&corner| (corner as usize) < points));
}

/// Maps in X3P, the container.
pub fn x3p(bytes: &[u8]) -> bool {
    let Ok(file) = parse_x3p(path(), bytes) else { return false };
    assert_map(&file);
    true
}

/// The document of an X3P container, which is sound and holds 48 bytes of heights.
pub fn x3p_document(bytes: &[u8]) -> bool {
    let mut zip = zip::ZipWriter::new(Cursor::new(Vec::new()));
    for (name, content) in [("main.xml", bytes), ("bindata/data.bin", &[0; 48])] {
        let options = zip::write::SimpleFileOptions::default().compression_method(zip::CompressionMethod::Stored);
        zip.start_file(name, options).expect("room in memory");
        zip.write_all(content).expect("room in memory");
    }
    x3p(&zip.finish().expect("room in memory").into_inner())
}

fn assert_map(file: &X3pFile) {
    match file {
        X3pFile::Map(map) => assert_heights(map),
        X3pFile::Points(points) => assert_believable(points),
    }
}

fn assert_heights(map: &HeightMap) {
    let GridMap { grid, values_mm, valid } = &map.heights;
    assert!(grid.len() == values_mm.len() && valid.len() == values_mm.len());
    assert!(values_mm.iter().all(|v| v.is_finite()) && valid.contains(&true));
    assert!(map.pv_mm() >= 0.0 && map.rms_mm() >= 0.0);
    assert_eq!(map.points().len(), map.measured_count());
    assert!(map.points().iter().all(|p| p.iter().all(|v| v.is_finite())));
}

/// Faces in STEP and IGES, the largest as a surface.
pub fn cad(bytes: &[u8]) -> bool {
    let Ok(model) = parse_cad(path(), bytes) else { return false };
    assert!(!model.faces.is_empty());
    for face in model.faces.iter().take(2).filter_map(|face| face.face.as_ref().ok()) {
        assert!(face.area_mm2() >= 0.0 || face.area_mm2().is_nan());
        let Ok(placed) = face.place(FaceFrame::Face, None, Sampling::Spacing { spacing_mm: 1.0 }) else { continue };
        let found = placed.surface.formula().sag_and_gradient(0.0, 0.0);
        assert!(found.is_none_or(|(z, gradient)| (z + gradient[0] + gradient[1]).is_finite()));
    }
    true
}

/// Surfaces of lenses, of Zemax and Code V.
pub fn lens(bytes: &[u8]) -> bool {
    let Ok(lens) = parse_lens(path(), bytes) else { return false };
    assert!(!lens.surfaces.is_empty());
    for surface in lens.surfaces.iter().take(20) {
        let Ok(formula) = &surface.surface else { continue };
        let found = formula.sag_and_gradient(1.0, 2.0);
        assert!(found.is_none_or(|(z, gradient)| (z + gradient[0] + gradient[1]).is_finite()));
    }
    true
}

/// Maps of heights of any format.
pub fn map(bytes: &[u8]) -> bool {
    // Maps that do not state the distance of their samples are read with it.
    let map = parse_map(path(), bytes, None).or_else(|_| parse_map(path(), bytes, Some(0.5)));
    let Ok(points) = map.or_else(|_| parse_scanner_cloud(path(), bytes)) else { return false };
    assert_believable(&points);
    !points.is_empty()
}

/// Maps in SDF.
pub fn sdf(bytes: &[u8]) -> bool {
    let Ok(map) = parse_sdf(path(), bytes) else { return false };
    assert_heights(&map);
    true
}

/// Maps of MetroPro.
pub fn metropro(bytes: &[u8]) -> bool {
    let Ok(map) = parse_metropro(path(), bytes) else { return false };
    assert_heights(&map);
    true
}

// ---- files of measurements ----------------------------------------------------------------------------------------------------------

/// The result file of a file exchange, by what cells may know of it, and as the measurement by a plan.
pub fn result(bytes: &[u8]) -> bool {
    let _ = check_ended(path(), bytes);
    let mut is_read = false;
    for (coordinates, decimal, unit, height_unit) in [
        (None, DecimalMark::Auto, Unit::Millimetre, None),
        (Some(Coordinates::Centres), DecimalMark::Comma, Unit::Millimetre, Some(Unit::Micrometre)),
        (Some(Coordinates::Contacts), DecimalMark::Point, Unit::Inch, None),
    ] {
        let content = Content { coordinates, decimal, unit, height_unit, ..Content::default() };
        let Ok(file) = parse_result(path(), bytes, &content) else { continue };
        is_read = true;
        assert!(file.points.iter().all(|p| p.iter().all(|v| v.abs() <= LIMIT_MM * content.unit.in_mm())));
        assert!(file.indices.as_ref().is_none_or(|all| all.len() == file.points.len()));
        assert!(file.names.as_ref().is_none_or(|all| all.len() == file.points.len()));
        let told = [file.probe_radius_mm, file.statements.temperature_c, file.statements.unit.map(Unit::in_mm)];
        assert!(told.into_iter().flatten().all(f64::is_finite));
        let targets = [0, 1, 2, 7];
        for targets in [None, Some(&targets[..])] {
            let wanted =
                ResultRequirements { targets, content: &content, probe_radius_mm: 1.5, probe_tolerance_mm: 0.01 };
            if let Ok(read) = wanted.read(path(), bytes) {
                let assigned = wanted.assign_by_index(path(), &read);
                assert!(assigned.is_err() || targets.is_none() || assigned.is_ok_and(|all| all.len() == 4));
            }
        }
    }
    is_read
}

/// Reference points, as YAML and as points.
pub fn references(bytes: &[u8]) -> bool {
    let mut is_read = false;
    for (name, group) in [("r.yaml", None), ("r.yaml", Some("primary")), ("r.csv", None)] {
        if let Ok(found) = parse_references(Path::new(name), bytes, group) {
            assert!(found.points.iter().all(|p| p.at.iter().all(|v| v.abs() <= LIMIT_MM)));
            is_read = true;
        }
    }
    is_read
}

// ---- what people write --------------------------------------------------------------------------------------------------------------

/// A nominal surface by its formula.
pub fn definition(bytes: &[u8]) -> bool {
    let Ok(text) = std::str::from_utf8(bytes) else { return false };
    let Ok(surface) = DefinedSurface::from_toml(text) else { return false };
    let bounds = surface.aperture().bounds();
    assert!(bounds.iter().flatten().all(|v| v.is_finite()));
    for share in [0.0, 0.3, 0.5, 1.0] {
        let [x, y] = [0, 1].map(|k| bounds[0][k] + share * (bounds[1][k] - bounds[0][k]));
        if let Some((sag, gradient)) = surface.formula().sag_and_gradient(x, y) {
            assert!(sag.is_finite() && gradient.iter().all(|v| v.is_finite()));
        }
    }
    true
}

/// A recipe, beside those that ship.
pub fn recipe(bytes: &[u8]) -> bool {
    let Ok(text) = std::str::from_utf8(bytes) else { return false };
    assert_told(text, Recipe::parse(&root().join("recipes/any.toml"), text).err())
}

/// A cell file, beside those that ship.
pub fn cell(bytes: &[u8]) -> bool {
    let Ok(text) = std::str::from_utf8(bytes) else { return false };
    assert_told(text, CellConfig::parse(&root().join("config/any.toml"), text).err())
}

/// Every problem has a place in the text.
fn assert_told(text: &str, problems: Option<Problems>) -> bool {
    let Some(problems) = problems else { return true };
    assert!(!problems.problems.is_empty() && !problems.to_string().is_empty());
    for problem in &problems.problems {
        assert!(text.get(problem.span.clone()).is_some(), "{problem}");
        assert!(problems.place(problem) >= (1, 1));
    }
    false
}

// ---- programs -----------------------------------------------------------------------------------------------------------------------

/// A program that exists already, corrected along z and along the normals of a plane, and along z in each dialect.
pub fn program(bytes: &[u8]) -> bool {
    let folder = folder();
    let (base, out) = (folder.path().join("base.ngc"), folder.path().join("out.ngc"));
    fs::write(&base, bytes).expect("a folder for temporary files");
    let grid = Grid { columns: 5, rows: 4, first_mm: [-20.0, -15.0], spacing_mm: [10.0, 10.0] };
    let values: Vec<f64> = (0..grid.len()).map(|k| 1e-3 * (k as f64).sin()).collect();
    let shift = HeightField::spline(grid, &values);
    let plane = HeightField::spline(grid, &vec![0.0; grid.len()]);
    let nominal = TargetSurface::new(plane, &Correction::zero(grid, 0.0), 1.0).expect("finite values");
    let map = ProgramMap {
        nodes: GridMap::all_valid(grid, values),
        kind: MapKind::Correction,
        identity: [7; 32],
        part: None,
        base: MapBase::Anything,
        simulation: true,
    };
    let mut is_read = false;
    let dialects = ["fanuc", "sinumerik", "heidenhain"]
        .map(|name| read_named_dialect(name, Path::new("")).expect("a dialect of the program").dialect);
    let along = AlongNormals { nominal: &nominal, centre_above_mm: 5.0 };
    let cases = [(None, None), (Some(along), None)];
    let cases = cases.into_iter().chain(dialects.iter().map(|dialect| (None, Some(dialect))));
    for (along_normals, dialect) in cases {
        let amendment = Amendment {
            shift: &shift,
            along_normals,
            tolerance_mm: 1e-3,
            map: &map,
            gain: 1.0,
            dialect,
            max_shift_mm: 0.5,
        };
        let amended = correct_program(&base, &out, &amendment);
        // The two interpreters agree on whatever is not refused.
        assert!(!amended.as_ref().is_err_and(|error| error.to_string().contains("report it with")), "{amended:?}");
        if let Ok(amended) = amended {
            assert!(amended.max_shift_mm.is_finite());
            let text = fs::read_to_string(&out).expect("the program that was written");
            let words = text.lines().filter(|line| !line.contains(['(', ';']));
            assert!(words.into_iter().all(|line| !line.contains("NaN") && !line.contains("inf")));
            is_read = true;
        }
    }
    is_read
}

/// A map to correct a program by.
pub fn program_map(bytes: &[u8]) -> bool {
    let folder = folder();
    let file = folder.path().join("map.csv");
    fs::write(&file, bytes).expect("a folder for temporary files");
    // The report draws an error map without its grid.
    if let Ok(nodes) = read_error_map(&file) {
        assert!(nodes.iter().flat_map(|node| [node.error(), node.sigma()]).flatten().all(f64::is_finite));
    }
    let Ok(map) = read_program_map(&file) else { return false };
    assert!(map.nodes.grid.is_valid() && map.nodes.grid.len() == map.nodes.values_mm.len());
    assert!(map.nodes.values_mm.iter().all(|v| v.is_finite()));
    true
}

fn folder() -> TempDir {
    tempfile::tempdir().expect("a folder for temporary files")
}

// ---- the record ---------------------------------------------------------------------------------------------------------------------

/// The journal of a small run as it lies on the disk, and its anchor.
const JOURNAL: &[u8] = include_bytes!("../../fuzz/journal/journal.sqlite");
const ANCHOR: &[u8] = include_bytes!("../../fuzz/journal/journal.anchor");

/// Reads and verifies a run of these files.
fn judge(journal: &[u8], anchor: &[u8]) -> bool {
    let home = folder();
    for (name, content) in [("journal.sqlite", journal), ("journal.anchor", anchor), ("measured.csv", b"1,2,3\n")] {
        fs::write(home.path().join(name), content).expect("a folder for temporary files");
    }
    if let Ok(reader) = Reader::open(home.path()) {
        let lines = reader.records(0).take(1000).map_while(Result::ok).map(|record| record.json_line());
        assert!(lines.count() < 1000, "the records have no end");
    }
    verify(home.path()).is_ok()
}

/// A journal in which some bytes were changed: three bytes a change, where and to what; or, after a first byte of 0xff,
/// any file.
///
/// What is verified is then what was written: a change is found, unless it is where SQLite keeps nothing.
pub fn journal(bytes: &[u8]) -> bool {
    if let Some((0xff, file)) = bytes.split_first() {
        return judge(file, ANCHOR);
    }
    let mut changed = JOURNAL.to_vec();
    for change in bytes.as_chunks::<3>().0 {
        let at = usize::from(u16::from_le_bytes([change[0], change[1]])) % changed.len();
        changed[at] = change[2];
    }
    judge(&changed, ANCHOR)
}

/// The anchor beside a journal: only one with the head that is there is believed, or one of no record, which proves
/// nothing.
pub fn anchor(bytes: &[u8]) -> bool {
    let is_believed = judge(JOURNAL, bytes);
    if is_believed {
        let anchor: Anchor = serde_json::from_slice(bytes).expect("what was believed can be read");
        let sound: Anchor = serde_json::from_slice(ANCHOR).expect("an anchor");
        assert!(anchor == sound || anchor.records == 0 || anchor.records < sound.records);
    }
    is_believed
}

/// The content of a record: in its canonical form it says the same, and is the same again.
pub fn record(bytes: &[u8]) -> bool {
    let Ok(value) = serde_json::from_slice::<Value>(bytes) else { return false };
    let text = canonical_json(&value);
    let again: Value = serde_json::from_str(&text).expect("canonical JSON is JSON");
    assert_eq!(again, value);
    assert_eq!(canonical_json(&again), text);
    true
}

/// Reads each line as an event, a command, a judgement or an ending of the cell, in the form of the record.
/// Returns true if at least one line is valid.
pub fn event(bytes: &[u8]) -> bool {
    let mut read = 0;
    for line in bytes.split(|&b| b == b'\n') {
        let kinds = [comes_back::<Event>, comes_back::<Command>, comes_back::<Judgement>, comes_back::<Ending>];
        read += usize::from(kinds.map(|comes_back| comes_back(line)).contains(&true));
    }
    read > 0
}

/// Reads each line as the content of a record: its kind, a tab, and its payload. Returns true if at least one line is
/// valid. Asserts that a content does not change when it is written and read again.
pub fn content(bytes: &[u8]) -> bool {
    let mut read = 0;
    for line in bytes.split(|&b| b == b'\n') {
        let Some((kind, payload)) = str::from_utf8(line).ok().and_then(|line| line.split_once('\t')) else { continue };
        let (Ok(kind), Ok(payload)) = (kind.parse::<RecordKind>(), serde_json::from_str(payload)) else { continue };
        let Ok(content) = regrind::record::Content::from_payload(kind, payload) else { continue };
        let written = content.payload();
        let again = regrind::record::Content::from_payload(kind, written.clone());
        assert_eq!(again.expect("what was written can be read").payload(), written);
        read += 1;
    }
    read > 0
}

/// An order over the control socket, and the answer to one.
pub fn order(bytes: &[u8]) -> bool {
    comes_back::<Request>(bytes) | comes_back::<Reply>(bytes)
}

/// Returns true if the bytes are a valid `T`.
/// Asserts that the value does not change when it is written and read again.
fn comes_back<T: DeserializeOwned + Serialize>(bytes: &[u8]) -> bool {
    let Ok(found) = serde_json::from_slice::<T>(bytes) else { return false };
    let text = serde_json::to_string(&found).expect("what was read can be written");
    let again: T = serde_json::from_str(&text).unwrap_or_else(|error| panic!("{text}: {error}"));
    assert_eq!(serde_json::to_string(&again).expect("what was read can be written"), text);
    true
}

/// Reads the file of learned errors that a run leaves to the next part.
/// Asserts that its first correction is finite.
pub fn learned(bytes: &[u8]) -> bool {
    let Ok(learned) = Learned::from_saved(Path::new("learned.json"), bytes) else { return false };
    assert!(learned.correction.grid.is_valid());
    let grid = Grid { columns: 3, rows: 3, first_mm: [-1.0, -1.0], spacing_mm: [1.0, 1.0] };
    let first = learned.first_correction(Correction::zero(grid, 0.05));
    assert!(first.values_mm.iter().all(|v| v.is_finite()));
    true
}

// ---- wires --------------------------------------------------------------------------------------------------------------------------

/// Decodes a payload that a simulated machine receives or sends. The first byte selects the kind of payload.
pub fn payload(bytes: &[u8]) -> bool {
    let Some((kind, bytes)) = bytes.split_first() else { return false };
    match kind % 6 {
        0 => comes_back_exactly(bytes, payload::Plan::decode, |plan| Some(plan.encode())),
        1 => comes_back_exactly(bytes, payload::Map::decode, |map| {
            assert!(map.displacement_at(0.0, 0.0).is_finite() && map.max_abs_mm() >= 0.0);
            Some(map.encode())
        }),
        2 => comes_back_exactly(bytes, payload::Pass::decode, |pass| Some(pass.encode())),
        3 => comes_back_exactly(bytes, |b| payloads::decode_pass_record(b).ok_or(()), |_| None),
        4 => comes_back_exactly(
            bytes,
            |b| payloads::decode_points(b, None).ok_or(()),
            |all| Some(payload::encode_points(all, None)),
        ),
        _ => comes_back_exactly(bytes, |b| payloads::decode_points(b, Some(1e-6)).ok_or(()), |_| None),
    }
}

fn comes_back_exactly<T, E>(
    bytes: &[u8],
    decode: impl Fn(&[u8]) -> Result<T, E>,
    encode: impl Fn(&T) -> Option<Vec<u8>>,
) -> bool {
    let Ok(found) = decode(bytes) else { return false };
    if let Some(written) = encode(&found) {
        assert_eq!(written.len(), bytes.len());
        assert!(decode(&written).is_ok(), "what was read is refused once it is written");
    }
    true
}

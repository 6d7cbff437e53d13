//! Maps written as X3P.

use std::io::{Cursor, Write};
use std::path::Path;

use data_encoding::HEXLOWER;
use md5::{Digest, Md5};
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipWriter};

use crate::error::FormatError;
use crate::height_map::HeightMap;
use crate::registration::write_atomic;
use regrind_core::compensation::ErrorMap;
use regrind_core::geometry::{Grid, GridMap};

/// Statements of a file about the origin of its map.
#[derive(Clone, Debug, PartialEq)]
pub struct MapRecord {
    /// Time when the map was computed or measured, as in `2026-03-01T12:00:00Z`.
    pub date: String,
    /// Person or program that created the map.
    pub creator: String,
    /// Instrument or program with which the map was created.
    pub instrument: String,
    /// Further remarks, in one or several lines.
    pub comment: String,
}

/// Writes the error map of a part to the file `path` in the X3P format. The heights in the file are the errors in
/// metres, at x and y of the model frame. An error is positive where the part has too much material. `date` is the time
/// in the header, such as `2026-03-01T12:00:00Z`. If `simulation` is true, the comment in the file begins with
/// `SIMULATION.`.
///
/// Nodes that were not measured are NaN and marked in the mask. The same map, date and `simulation` give the same
/// bytes.
///
/// # Errors
/// The same as for [`write_x3p`].
pub fn write_error_map_x3p(path: &Path, map: &ErrorMap, date: &str, simulation: bool) -> Result<(), FormatError> {
    let samples = map.nodes.values_mm.iter().zip(&map.nodes.valid).map(|(value, valid)| valid.then_some(*value));
    let heights = HeightMap::new(path, map.nodes.grid, samples)?;
    let marked = if simulation { "SIMULATION. " } else { "" };
    let record = MapRecord {
        date: date.to_owned(),
        creator: "Regrind".to_owned(),
        instrument: "error map, registered and filtered".to_owned(),
        comment: format!(
            "{marked}Error of the part over x and y of its model frame; positive stands proud, along the outward normal"
        ),
    };
    write_x3p(path, &heights, &record)
}

/// Writes a height map to the file `path` in the X3P format. `record` has the statements of the header: date, creator,
/// instrument and comment. Heights are written in metres as 64-bit floating-point numbers. Samples that were not
/// measured are NaN, and the mask of valid samples marks them.
///
/// # Errors
/// The file cannot be written. An existing file at `path` then stays unchanged.
pub fn write_x3p(path: &Path, map: &HeightMap, record: &MapRecord) -> Result<(), FormatError> {
    let failed = |source: zip::result::ZipError| FormatError::Unwritable {
        path: path.to_owned(),
        action: "packing it",
        source: source.into(),
    };
    write_atomic(path, &packed(map, record).map_err(failed)?)
}

fn packed(map: &HeightMap, record: &MapRecord) -> Result<Vec<u8>, zip::result::ZipError> {
    let GridMap { values_mm, valid, .. } = &map.heights;
    let metres = values_mm.iter().zip(valid).map(|(z, valid)| if *valid { 1e-3 * z } else { f64::NAN });
    let data: Vec<u8> = metres.flat_map(f64::to_le_bytes).collect();
    let mut mask = vec![0u8; valid.len().div_ceil(8)];
    for (k, _) in valid.iter().enumerate().filter(|(_, valid)| **valid) {
        mask[k / 8] |= 1 << (k % 8);
    }
    let xml = main_xml(map, record, &sum(&data), &sum(&mask)).into_bytes();
    let seal = format!("{} *main.xml\n", sum(&xml));
    let mut zip = ZipWriter::new(Cursor::new(Vec::new()));
    let options = SimpleFileOptions::default().compression_method(CompressionMethod::Deflated);
    let entries: [(&str, &[u8]); 4] = [
        ("main.xml", &xml),
        ("bindata/data.bin", &data),
        ("bindata/valid.bin", &mask),
        ("md5checksum.hex", seal.as_bytes()),
    ];
    for (name, bytes) in entries {
        zip.start_file(name, options)?;
        zip.write_all(bytes)?;
    }
    Ok(zip.finish()?.into_inner())
}

pub(super) fn sum(bytes: &[u8]) -> String {
    HEXLOWER.encode(&Md5::digest(bytes))
}

fn main_xml(map: &HeightMap, record: &MapRecord, data: &str, mask: &str) -> String {
    let axis = |name: &str, kind: &str, increment_m: f64, offset_m: f64| {
        format!(
            "      <{name}>\n        <AxisType>{kind}</AxisType>\n        <DataType>D</DataType>\n        \
             <Increment>{increment_m:e}</Increment>\n        <Offset>{offset_m:e}</Offset>\n      </{name}>\n"
        )
    };
    let [x, y] = [0, 1].map(|k| {
        axis(["CX", "CY"][k], "I", 1e-3 * map.heights.grid.spacing_mm[k], 1e-3 * map.heights.grid.first_mm[k])
    });
    let z = axis("CZ", "A", 1.0, 0.0);
    let MapRecord { date, creator, instrument, comment } = record;
    let [date, creator, instrument, comment] = [date, creator, instrument, comment].map(|text| escaped(text));
    let (version, Grid { columns, rows, .. }) = (env!("CARGO_PKG_VERSION"), map.heights.grid);
    format!(
        "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n\
         <p:ISO5436_2 xmlns:p=\"http://www.opengps.eu/2008/ISO5436_2\" xmlns:xsi=\"http://www.w3.org/2001/XMLSchema-instance\" \
         xsi:schemaLocation=\"http://www.opengps.eu/2008/ISO5436_2 http://www.opengps.eu/2008/ISO5436_2/ISO5436_2.xsd\">\n  \
         <Record1>\n    <Revision>ISO5436 - 2000</Revision>\n    <FeatureType>SUR</FeatureType>\n    <Axes>\n{x}{y}{z}    \
         </Axes>\n  </Record1>\n  <Record2>\n    <Date>{date}</Date>\n    <Creator>{creator}</Creator>\n    <Instrument>\n      \
         <Manufacturer>Regrind</Manufacturer>\n      <Model>{instrument}</Model>\n      <Serial>none</Serial>\n      \
         <Version>{version}</Version>\n    </Instrument>\n    <CalibrationDate>{date}</CalibrationDate>\n    <ProbingSystem>\n      \
         <Type>Software</Type>\n      <Identification>{instrument}</Identification>\n    </ProbingSystem>\n    \
         <Comment>{comment}</Comment>\n  </Record2>\n  <Record3>\n    <MatrixDimension>\n      <SizeX>{columns}</SizeX>\n      \
         <SizeY>{rows}</SizeY>\n      <SizeZ>1</SizeZ>\n    </MatrixDimension>\n    <DataLink>\n      \
         <PointDataLink>bindata/data.bin</PointDataLink>\n      <MD5ChecksumPointData>{data}</MD5ChecksumPointData>\n      \
         <ValidPointsLink>bindata/valid.bin</ValidPointsLink>\n      <MD5ChecksumValidPoints>{mask}</MD5ChecksumValidPoints>\n    \
         </DataLink>\n  </Record3>\n  <Record4>\n    <ChecksumFile>md5checksum.hex</ChecksumFile>\n  </Record4>\n\
         </p:ISO5436_2>\n"
    )
}

/// Returns `text` for use in XML or HTML: `<`, `>` and `&` become entities, and forbidden characters become U+FFFD.
pub fn escaped(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '<' => out.push_str("&lt;"),
            '>' => out.push_str("&gt;"),
            '&' => out.push_str("&amp;"),
            '\n' => out.push('\n'),
            c if c.is_control() || ('\u{fffe}'..='\u{ffff}').contains(&c) => out.push('\u{fffd}'),
            c => out.push(c),
        }
    }
    out
}

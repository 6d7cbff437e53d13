//! Maps in HDF5 files: Zygo Mx (`.datx`) and 4D (`.h5`, `.4D`). The groups of a file tell whose it is.
//!
//! Zygo Mx: `/MetaData` leads to the surface in `/Data/Surface`; its attributes have the unit, the mark of samples that
//! were not measured, and the converters of x, y and z. 4D: `/measurement0/genraw/data` in waves. The top row is first.

use std::path::Path;

use hdf5_reader::{Dataset, Hdf5File, OpenOptions};

use super::super::error::FormatError;
use super::super::height_map::{HeightMap, MAX_SAMPLES, MapFormat, check_size};
use super::hdf5_value::{Value, attribute, numbers, table};
use super::{MARK, checked_factor, checked_wavelength_nm, length_mm, map_from_top, unexpected};

const MAGIC: &[u8] = b"\x89HDF\r\n\x1a\n";

/// Largest number of bytes that one dataset unpacks to: the largest map in 64 bits.
const MAX_DECODED: usize = 8 * MAX_SAMPLES as usize;

/// Largest ratio of the bytes of a dataset to those of its file. Deflate packs 1032 bytes into one at the most.
const MAX_RATIO: usize = 1100;

/// HDF5 format, detected by its first bytes.
pub(in super::super) const FORMAT: MapFormat = MapFormat {
    begins: |head| head.starts_with(MAGIC),
    parse: |path, bytes, given_mm| parse_hdf5(path, bytes, given_mm).map(Into::into),
};

/// Attributes of a dataset or group, decoded when they are asked for.
struct Attributes<'a> {
    path: &'a Path,
    file: &'a Hdf5File,
    name: String,
    list: Vec<hdf5_reader::Attribute>,
}

fn parse_hdf5(path: &Path, bytes: &[u8], given_mm: Option<f64>) -> Result<HeightMap, FormatError> {
    let limit = bytes.len().saturating_mul(MAX_RATIO).min(MAX_DECODED);
    let options = OpenOptions::default().with_max_read_bytes(limit).with_max_chunk_bytes(limit);
    let file = Hdf5File::from_vec_with_options(bytes.to_vec(), options);
    let file = file.map_err(|error| unexpected(path, "file", "HDF5", error.to_string()))?;
    if file.group("/measurement0/genraw").is_ok() || file.group("/measurement0").is_ok() {
        return four_d(path, &file, ("/measurement0/genraw", "data", "wavelength"), given_mm);
    }
    if file.dataset("/Measurement/SurfaceInWaves/Data").is_ok() {
        return four_d(path, &file, ("/Measurement", "SurfaceInWaves/Data", "WavelengthInNanometers"), given_mm);
    }
    zygo_mx(path, &file, given_mm)
}

/// Reads the surface of Zygo Mx.
fn zygo_mx(path: &Path, file: &Hdf5File, given_mm: Option<f64>) -> Result<HeightMap, FormatError> {
    let place = surface_path(path, file)?;
    let surface = dataset(path, file, &place)?;
    let attributes = Attributes { path, file, name: place.clone(), list: surface.attributes() };
    let z = attributes.get("Z Converter")?;
    let z_unit = z.as_ref().and_then(|z| z.member("BaseUnit")).and_then(Value::text);
    let unit = attributes.get("Unit")?;
    let unit = unit.as_ref().and_then(Value::text).or(z_unit);
    let unit = unit.ok_or_else(|| unexpected(path, &place, "an attribute Unit", "none"))?;
    if let Some(other) = z_unit.filter(|other| *other != unit) {
        return Err(unexpected(path, &place, &format!("the unit of Unit and of Z Converter alike ({unit})"), other));
    }
    let wavelength_mm = || attributes.factor("Wavelength").map(|wavelength_m| 1e3 * wavelength_m);
    let mut note = None;
    let unit_mm = match unit {
        "Fringes" => {
            let obliquity = if attributes.has("Obliquity Factor") {
                attributes.factor("Obliquity Factor")?
            } else {
                note = Some("the file states no obliquity factor; the heights were read with the factor 1".to_owned());
                1.0
            };
            wavelength_mm()? * attributes.factor("Interferometric Scale Factor")? * obliquity
        }
        "Waves" => wavelength_mm()?,
        other => length_mm(other).ok_or_else(|| unexpected(path, &place, "a surface in a unit of length", other))?,
    };
    let spacing_mm = [attributes.pitch_mm("X Converter")?, attributes.pitch_mm("Y Converter")?];
    let mark = if attributes.has("No Data") { attributes.number("No Data")? } else { f64::MAX };
    let mark = mark.min(MARK);
    // The mark is stored with the digits of the heights: 2147483640 is 2147483648 in 32 bits.
    let is_height = |value: f64| value.is_finite() && value < mark && value.abs() < MARK;
    let height = |value| is_height(value).then_some(value * unit_mm);
    let mut map = map_of(path, &place, &surface, (spacing_mm, given_mm), height)?;
    map.notes.extend(note);
    Ok(map)
}

/// Returns the path of the surface: the one to which the table of metadata leads, or the only one.
fn surface_path(path: &Path, file: &Hdf5File) -> Result<String, FormatError> {
    if let Ok(metadata) = file.dataset("/MetaData") {
        let root = file.root_group().map_err(|error| unexpected(path, "/", "a group", error.to_string()))?;
        let rows = table(&metadata, &root).map_err(|error| unexpected(path, "/MetaData", "a table", error))?;
        let find = |source: &str, link: &str| {
            let cell = |row: &'_ Value, name: &str| row.member(name).and_then(Value::text).map(ToOwned::to_owned);
            rows.iter()
                .find(|row| {
                    cell(row, "Source").as_deref() == Some(source) && cell(row, "Link").as_deref() == Some(link)
                })
                .and_then(|row| cell(row, "Destination"))
        };
        let surface = find("Root", "Measurement").and_then(|measurement| find(&measurement, "Surface"));
        if let Some(place) = surface.and_then(|surface| find(&surface, "Path")) {
            return Ok(place);
        }
    }
    if let Ok(group) = file.group("/Data/Surface") {
        let surfaces =
            group.datasets().map_err(|error| unexpected(path, "/Data/Surface", "a group", error.to_string()))?;
        return match &surfaces[..] {
            [surface] => Ok(format!("/Data/Surface/{}", surface.name())),
            other => Err(unexpected(path, "/Data/Surface", "one surface", format!("{} surfaces", other.len()))),
        };
    }
    if file.dataset("/Measurement/Surface").is_ok() {
        return Ok("/Measurement/Surface".to_owned());
    }
    Err(unexpected(path, "groups", "those of Zygo Mx (/Data/Surface) or of 4D (/measurement0/genraw)", "others"))
}

/// Reads a surface of 4D, in waves: the dataset `data` of `group`, whose attribute `key` has the wavelength in nm. Its
/// files do not have the distance of the samples on the part, and do not say which row is the top one.
fn four_d(
    path: &Path,
    file: &Hdf5File,
    (group, data, key): (&str, &str, &str),
    given_mm: Option<f64>,
) -> Result<HeightMap, FormatError> {
    let place = format!("{group}/{data}");
    let surface = dataset(path, file, &place)?;
    let found = file.group(group).map_err(|error| unexpected(path, group, "a group", error.to_string()))?;
    let list = found.attributes().map_err(|error| unexpected(path, group, "attributes", error.to_string()))?;
    let attributes = Attributes { path, file, name: group.to_owned(), list };
    let wavelength = attributes.get(key)?;
    let wavelength_nm = wavelength.as_ref().and_then(|value| match value.text() {
        Some(text) => text.strip_suffix("nm").and_then(|number| number.trim().parse().ok()),
        None => value.number(),
    });
    let wavelength_nm = wavelength_nm.ok_or_else(|| unexpected(path, group, "a wavelength in nm", "none"))?;
    let wave_mm = 1e-6 * checked_wavelength_nm(path, &format!("{group}, {key}"), wavelength_nm)?;
    let height = |waves: f64| (waves.is_finite() && waves.abs() < MARK).then_some(waves * wave_mm);
    let mut map = map_of(path, &place, &surface, ([0.0; 2], given_mm), height)?;
    map.notes.push("files of 4D do not say which row is the top one; the first row is taken as the top one".to_owned());
    Ok(map)
}

fn dataset(path: &Path, file: &Hdf5File, place: &str) -> Result<Dataset, FormatError> {
    file.dataset(place).map_err(|error| unexpected(path, place, "a dataset", error.to_string()))
}

fn map_of(
    path: &Path,
    place: &str,
    surface: &Dataset,
    spacing_mm: ([f64; 2], Option<f64>),
    height: impl Fn(f64) -> Option<f64>,
) -> Result<HeightMap, FormatError> {
    let &[rows, columns] = surface.shape() else {
        return Err(unexpected(path, place, "rows and columns", format!("{:?}", surface.shape())));
    };
    check_size(path, columns, rows)?;
    debug_assert!(columns * rows <= MAX_SAMPLES);
    let values = numbers(surface).map_err(|error| unexpected(path, place, "heights", error))?;
    if values.len() as u64 != columns * rows {
        return Err(unexpected(path, place, &format!("{columns} times {rows} heights"), values.len().to_string()));
    }
    map_from_top(path, [columns as usize, rows as usize], spacing_mm, |index| height(values[index]))
}

impl Attributes<'_> {
    fn has(&self, name: &str) -> bool {
        self.list.iter().any(|attribute| attribute.name == name)
    }

    fn get(&self, name: &str) -> Result<Option<Value>, FormatError> {
        let Some(found) = self.list.iter().find(|attribute| attribute.name == name) else { return Ok(None) };
        let wrong = |error: String| unexpected(self.path, &format!("{}, {name}", self.name), "an attribute", error);
        let root = self.file.root_group().map_err(|error| wrong(error.to_string()))?;
        attribute(found, &root).map(Some).map_err(wrong)
    }

    fn number(&self, name: &str) -> Result<f64, FormatError> {
        let number = self.get(name)?.as_ref().and_then(Value::number);
        number.ok_or_else(|| unexpected(self.path, &self.name, &format!("a number in the attribute {name}"), "none"))
    }

    /// Returns a number that lengths are multiplied by.
    fn factor(&self, name: &str) -> Result<f64, FormatError> {
        checked_factor(self.path, &format!("{}, {name}", self.name), "a number", self.number(name)?)
    }

    /// Returns the distance of the samples that a converter states: its second parameter, in metres.
    fn pitch_mm(&self, name: &str) -> Result<f64, FormatError> {
        let converter = self.get(name)?;
        let unit = converter.as_ref().and_then(|converter| converter.member("BaseUnit")).and_then(Value::text);
        // The parameters are in metres for a pixel. Another unit would make them lengths of something else.
        if let Some(other) = unit.filter(|unit| !matches!(unit.trim(), "Pixels" | "Meters")) {
            let place = format!("{}, {name}", self.name);
            return Err(unexpected(self.path, &place, "a converter of pixels to metres", other));
        }
        let parameters = converter.as_ref().and_then(|converter| converter.member("Parameters"));
        match parameters {
            Some(Value::List(list)) => match list.get(1).and_then(Value::number) {
                Some(pitch_m) => Ok(1e3 * pitch_m),
                None => {
                    let place = format!("{}, {name}", self.name);
                    Err(unexpected(self.path, &place, "a number as the second parameter", format!("{list:?}")))
                }
            },
            _ => Err(unexpected(self.path, &self.name, &format!("an attribute {name} with parameters"), "none")),
        }
    }
}

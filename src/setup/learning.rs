//! Identity of the settings under which a run may start from the results of an earlier run.
//!
//! The identity is the hash of a document with a version. The document has names of its own, so that a renamed key of a
//! recipe or a renamed variant in the program changes no identity. Only the table `[simulation]` is taken as the recipe
//! has it. A change of what the document has needs a new version. [`SettingIdentity::earlier`] is the text that
//! versions up to 0.2 wrote; its form is frozen.

use data_encoding::HEXLOWER;
use serde::Serialize;
use sha2::{Digest, Sha256};

use crate::cell::FirstStep;
use crate::compensation::{FilterOrder, GainRule, Smoothing, SplineSmoothness};
use crate::config::CellConfig;
use crate::formats::SettingIdentity;
use crate::recipe::{Recipe, SpindleAxis, Tilt, TiltKind, WheelDimensions};
use crate::registration::Coordinate;

/// Version of both documents.
const VERSION: u32 = 1;

/// Returns the identity of all settings that affect the errors of a pass: the name of the cell, and `kind` from
/// [`learning_kind`]. In a simulated cell, the settings of the simulation are added. A run can start from the results of
/// an earlier run only if both have this identity.
pub(super) fn learning_setting(recipe: &Recipe, cell: &CellConfig, kind: &SettingIdentity) -> SettingIdentity {
    #[derive(Serialize)]
    struct Document<'a> {
        version: u32,
        cell: &'a str,
        kind: &'a str,
        simulation: Option<serde_json::Value>,
    }
    // Another simulated world counts as another grinder.
    let simulation = recipe.simulation.as_ref().filter(|_| cell.simulated).map(|world| serde_json::json!(world));
    let mut earlier = format!("cell {:?}, {}", cell.name, kind.earlier);
    if let Some(world) = &simulation {
        earlier += &format!("; simulation {world}");
    }
    let document = Document { version: VERSION, cell: &cell.name, kind: &kind.id, simulation };
    SettingIdentity { id: identity("setting", &document), earlier }
}

/// Returns the identity of the settings that affect the errors of a pass, except the cell. These are the part and the
/// settings of grinding, measuring and compensation. A run can start from the results of a run in another cell only if
/// both have this identity.
///
/// `part` is the SHA-256 that identifies the nominal surface, `track_mm` the distance between the tracks of the wheel,
/// and `targets` the number of points to measure.
pub(super) fn learning_kind(recipe: &Recipe, part: &[u8; 32], track_mm: f64, targets: usize) -> SettingIdentity {
    let (grinding, measure, map) = (&recipe.grinding, &recipe.measure, &recipe.compensation);
    let document = KindDocument {
        version: VERSION,
        part_sha256: HEXLOWER.encode(part),
        begin_with: match recipe.cycle.begin_with {
            FirstStep::Grind => "grind",
            FirstStep::Measure => "measure",
        },
        wheel: WheelDocument::new(&grinding.wheel),
        feed_mm_min: grinding.feed_mm_min,
        track_mm,
        spark_out_passes: grinding.spark_out_passes,
        depth_of_cut_mm: map.depth_of_cut_um.mm(),
        targets,
        probe_radius_mm: measure.probe_radius_mm,
        locked: Coordinate::locked_flags(&recipe.registration.lock),
        cutoff_mm: map.cutoff_mm,
        smoothing: match map.smoothing {
            Smoothing::Gaussian => "gaussian",
            Smoothing::RobustGaussian => "robust-gaussian",
            Smoothing::Spline => "spline",
        },
        filter_order: match map.filter_order {
            FilterOrder::Constant => "constant",
            FilterOrder::Plane => "plane",
            FilterOrder::Quadric => "quadric",
        },
        spline_smoothness: match map.roughness {
            SplineSmoothness::Cutoff => "cutoff",
            SplineSmoothness::CrossValidation => "cross-validation",
        },
        gain: match map.gain() {
            GainRule::Fixed(value) => GainDocument::Fixed { value },
            GainRule::Adaptive => GainDocument::Adaptive,
            GainRule::Wavelength => GainDocument::Wavelength,
        },
        tilt: grinding.tilt.map(|Tilt { lean, angle_deg }| TiltDocument {
            mode: match lean {
                TiltKind::Constant => "constant",
                TiltKind::Following => "following",
            },
            angle_deg,
        }),
    };
    SettingIdentity { id: identity("kind", &document), earlier: document.earlier_text() }
}

/// Returns the identity of a document: its name, its version and the SHA-256 of its JSON text.
fn identity(name: &str, document: &impl Serialize) -> String {
    // Numbers, texts and lists have a JSON form.
    let text = serde_json::to_string(document).unwrap_or_default();
    let digest = Sha256::digest(format!("regrind {name} {VERSION}\n{text}"));
    format!("{name} {VERSION} {}", HEXLOWER.encode(&digest))
}

/// Settings that the passes of two cells share if one cell can learn from the other.
#[derive(Serialize)]
struct KindDocument {
    version: u32,
    part_sha256: String,
    begin_with: &'static str,
    wheel: WheelDocument,
    feed_mm_min: f64,
    track_mm: f64,
    spark_out_passes: u16,
    depth_of_cut_mm: f64,
    targets: usize,
    probe_radius_mm: f64,
    /// Directions of the pose that the fixture holds: x, y, z, and the rotations about them.
    locked: [bool; 6],
    cutoff_mm: f64,
    smoothing: &'static str,
    filter_order: &'static str,
    spline_smoothness: &'static str,
    gain: GainDocument,
    tilt: Option<TiltDocument>,
}

#[derive(Serialize)]
#[serde(tag = "shape", rename_all = "kebab-case")]
enum WheelDocument {
    Sphere { radius_mm: f64 },
    Torus { radius_mm: f64, minor_radius_mm: f64, spindle: &'static str },
    Cup { radius_mm: f64, minor_radius_mm: f64, tilt_deg: Option<f64> },
}

impl WheelDocument {
    fn new(wheel: &WheelDimensions) -> Self {
        match *wheel {
            WheelDimensions::Sphere { radius_mm } => Self::Sphere { radius_mm },
            WheelDimensions::Torus { radius_mm, minor_radius_mm, spindle } => {
                let spindle = match spindle {
                    SpindleAxis::X => "x",
                    SpindleAxis::Y => "y",
                };
                Self::Torus { radius_mm, minor_radius_mm, spindle }
            }
            WheelDimensions::Cup { radius_mm, minor_radius_mm, tilt_deg } => {
                Self::Cup { radius_mm, minor_radius_mm, tilt_deg }
            }
        }
    }

    fn earlier_text(&self) -> String {
        match self {
            Self::Sphere { radius_mm } => format!("Sphere {{ radius_mm: {radius_mm:?} }}"),
            Self::Torus { radius_mm, minor_radius_mm, spindle } => format!(
                "Torus {{ radius_mm: {radius_mm:?}, minor_radius_mm: {minor_radius_mm:?}, spindle: {} }}",
                camel_case(spindle)
            ),
            Self::Cup { radius_mm, minor_radius_mm, tilt_deg } => {
                let tilt = tilt_deg.map_or("None".to_owned(), |angle| format!("Some({angle:?})"));
                format!("Cup {{ radius_mm: {radius_mm:?}, minor_radius_mm: {minor_radius_mm:?}, tilt_deg: {tilt} }}")
            }
        }
    }
}

#[derive(Serialize)]
#[serde(tag = "rule", rename_all = "kebab-case")]
enum GainDocument {
    Fixed { value: f64 },
    Adaptive,
    Wavelength,
}

#[derive(Serialize)]
struct TiltDocument {
    mode: &'static str,
    angle_deg: f64,
}

impl KindDocument {
    /// Returns the text that versions up to 0.2 wrote for these settings.
    fn earlier_text(&self) -> String {
        let gain = match self.gain {
            GainDocument::Fixed { value } => format!("Fixed({value:?})"),
            GainDocument::Adaptive => "Adaptive".to_owned(),
            GainDocument::Wavelength => "Wavelength".to_owned(),
        };
        let locked = self.locked.map(|held| held.to_string()).join(", ");
        let mut text = format!(
            "part {}, begin with {}; {}, feed {} mm/min, tracks {} mm, spark-out {}, depth {} mm; {} targets, probe {} mm, \
             held [{locked}]; cut-off {} mm, {}, gain {gain}",
            self.part_sha256,
            camel_case(self.begin_with),
            self.wheel.earlier_text(),
            self.feed_mm_min,
            self.track_mm,
            self.spark_out_passes,
            self.depth_of_cut_mm,
            self.targets,
            self.probe_radius_mm,
            self.cutoff_mm,
            camel_case(self.smoothing),
        );
        if let Some(TiltDocument { mode, angle_deg }) = &self.tilt {
            text += &format!("; tilt {} by {angle_deg} degrees", camel_case(mode));
        }
        // These versions omitted the values that are the default.
        if (self.filter_order, self.spline_smoothness) != ("plane", "cutoff") {
            text += &format!("; order {}, {}", camel_case(self.filter_order), camel_case(self.spline_smoothness));
        }
        text
    }
}

/// Converts a name such as `robust-gaussian` to `RobustGaussian`.
fn camel_case(name: &str) -> String {
    let word = |word: &str| {
        let mut letters = word.chars();
        letters.next().map_or(String::new(), |first| first.to_uppercase().chain(letters).collect::<String>())
    };
    name.split('-').map(word).collect()
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use crate::config::BUILT_IN_CELL;

    fn recipe(changes: &[(&str, &str)]) -> Recipe {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("recipes/freeform-mirror.toml");
        let mut text = std::fs::read_to_string(&path).unwrap();
        for (from, to) in changes {
            assert!(text.contains(from), "{from}");
            text = text.replacen(from, to, 1);
        }
        Recipe::parse(&path, &text).unwrap_or_else(|problems| panic!("{problems:?}"))
    }

    /// Recipes that differ from the shipped one in one setting each.
    fn variants() -> Vec<Recipe> {
        const WHEEL: &str = "shape = \"sphere\"\nradius_mm = 12.5";
        const CUTOFF: &str = "cutoff_mm = 5.0 ";
        let wheel = |to: &str| recipe(&[(WHEEL, to)]);
        let map = |more: &str| recipe(&[(CUTOFF, &format!("{more}\ncutoff_mm = 5.0 "))]);
        vec![
            recipe(&[]),
            wheel("shape = \"torus\"\nradius_mm = 75.0\nminor_radius_mm = 2.0\nspindle = \"x\""),
            wheel("shape = \"torus\"\nradius_mm = 75.0\nminor_radius_mm = 2.0"),
            wheel("shape = \"cup\"\nradius_mm = 40.0\nminor_radius_mm = 2.0"),
            wheel("shape = \"cup\"\nradius_mm = 40.0\nminor_radius_mm = 2.0\ntilt_deg = 20.0"),
            map("smoothing = \"robust-gaussian\""),
            map("smoothing = \"spline\"\nroughness = \"cross-validation\""),
            map("filter_order = \"quadric\""),
            map("gain = 0.8"),
            map("gain_by = \"adaptive\""),
            recipe(&[(CUTOFF, "cutoff_mm = 7.5 ")]),
        ]
    }

    #[test]
    fn earlier_text_is_that_of_earlier_versions() {
        let found: Vec<_> = variants().iter().map(|recipe| learning_kind(recipe, &[7; 32], 1.25, 300)).collect();
        assert_eq!(
            found[0].earlier,
            "part 0707070707070707070707070707070707070707070707070707070707070707, begin with Grind; Sphere { radius_mm: 12.5 }, feed 1000 mm/min, tracks 1.25 mm, spark-out 1, depth 0.02 mm; 300 targets, probe 1.5 mm, held [false, false, false, false, false, false]; cut-off 5 mm, Gaussian, gain Wavelength"
        );
        assert_eq!(
            found[1].earlier,
            "part 0707070707070707070707070707070707070707070707070707070707070707, begin with Grind; Torus { radius_mm: 75.0, minor_radius_mm: 2.0, spindle: X }, feed 1000 mm/min, tracks 1.25 mm, spark-out 1, depth 0.02 mm; 300 targets, probe 1.5 mm, held [false, false, false, false, false, false]; cut-off 5 mm, Gaussian, gain Wavelength"
        );
        let texts: Vec<&str> = found.iter().map(|identity| identity.earlier.as_str()).collect();
        assert_eq!(
            HEXLOWER.encode(&Sha256::digest(texts.join("\n"))),
            "7e31c9027f1061b51b8fc1b35453a1d61a13c4e339d0a75af16747ae93438bb6"
        );
        assert!(found.iter().all(|of| of.fits(&of.earlier) && of.fits(&of.id) && !of.fits("")));
    }

    #[test]
    fn identity_is_pinned_and_depends_on_each_setting() {
        let recipes = variants();
        let mut ids: Vec<String> = recipes.iter().map(|recipe| learning_kind(recipe, &[7; 32], 1.25, 300).id).collect();
        ids.push(learning_kind(&recipes[0], &[8; 32], 1.25, 300).id);
        ids.push(learning_kind(&recipes[0], &[7; 32], 1.5, 300).id);
        ids.push(learning_kind(&recipes[0], &[7; 32], 1.25, 301).id);
        // A changed identity takes from every cell what it has learned: raise the version, and read the former one.
        assert_eq!(ids[0], "kind 1 828f6692ef8a7c196d7936c252d13dd93bf2cd284a6b4337b372184db51ef68b");
        let count = ids.len();
        ids.sort();
        ids.dedup();
        assert_eq!(ids.len(), count);
    }

    #[test]
    fn setting_depends_on_cell_simulation_and_seed() {
        let (here, there) = (recipe(&[]), recipe(&[("seed = 1", "seed = 2")]));
        let cell = |name: &str, simulated: bool| {
            let mut cell = CellConfig::read(Path::new(BUILT_IN_CELL)).unwrap();
            (cell.name, cell.simulated) = (name.into(), simulated);
            cell
        };
        let kind = learning_kind(&here, &[7; 32], 1.25, 300);
        let of = |recipe: &Recipe, cell: &CellConfig| learning_setting(recipe, cell, &kind);
        let first = of(&here, &cell("a", true));
        assert_eq!(first, of(&here, &cell("a", true)));
        assert_ne!(first, of(&here, &cell("b", true)));
        assert_ne!(first, of(&there, &cell("a", true)));
        assert_ne!(first, of(&here, &cell("a", false)));
        // The world counts only if it is simulated.
        assert_eq!(of(&here, &cell("a", false)), of(&there, &cell("a", false)));
        let seeded = first.clone().with_seed(3);
        assert!(
            !first.fits(&seeded.id) && !seeded.fits(&first.id) && seeded.fits(&format!("{}, seed 3", first.earlier))
        );
    }
}

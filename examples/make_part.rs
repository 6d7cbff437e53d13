//! Makes a nominal surface and a measurement of a ground part as test input for the program: target/example/nominal.csv
//! and target/example/measured.csv.
//!
//! The free form of 102 x 62 mm has 451,401 nominal points. Its ground surface deviates by 6.657 um PV. The measurement
//! has 28,476 centres of a probe with a radius of 1.5 mm and noise of 0.2 um. The part is displaced by 20, 10, 20 mm
//! and 20, 20, 10 degrees. The output is the same every time.

use std::error::Error;
use std::path::Path;

use regrind::formats::{ResultFolder, write_points};
use regrind::geometry::Point;
use regrind_sim::form::FormError;
use regrind_sim::probe::{Placement, add_noise, centre};
use regrind_sim::shape::{FreeForm, Shape};

const RADIUS_MM: f64 = 1.5;
const FORM_PV_MM: f64 = 6.657e-3;
const NOISE_MM: f64 = 2e-4;
const SCAN: (usize, usize) = (226, 126);

fn main() -> Result<(), Box<dyn Error>> {
    let folder = ResultFolder::prepare(Path::new("target/example"))?;
    let (columns, rows) = FreeForm::PAPER_GRID;
    let nominal: Vec<Point> = FreeForm::default()
        .grid(FreeForm::WIDTH_MM, FreeForm::DEPTH_MM, columns, rows)
        .into_iter()
        .map(Point::from)
        .collect();
    let header = "x_mm,y_mm,z_mm";
    write_points(folder.path().join("nominal.csv"), header, &nominal)?;
    write_points(folder.path().join("measured.csv"), header, &measure())?;
    println!("{} and {} points in {}", nominal.len(), SCAN.0 * SCAN.1, folder.path().display());
    folder.keep();
    Ok(())
}

/// Returns the probe centres on the ground part, in the frame of the measuring machine.
fn measure() -> Vec<Point> {
    let shape = FreeForm::default();
    let form = FormError::new(1, 30.0, FORM_PV_MM, FreeForm::WIDTH_MM, FreeForm::DEPTH_MM);
    // A millimetre inside the edge, so that the ball touches the part at any slope.
    let at = |i: usize, n: usize, size: f64| (size - 2.0) * (i as f64 / (n - 1) as f64 - 0.5);
    let place = Placement::new([20.0, 10.0, 20.0], [20.0, 20.0, 10.0]);
    let mut centres: Vec<[f64; 3]> = (0..SCAN.0 * SCAN.1)
        .map(|k| {
            let x = at(k % SCAN.0, SCAN.0, FreeForm::WIDTH_MM);
            let y = at(k / SCAN.0, SCAN.1, FreeForm::DEPTH_MM);
            place.apply(centre(&shape, &form, RADIUS_MM, x, y))
        })
        .collect();
    add_noise(&mut regrind_sim::rng(1), &mut centres, NOISE_MM);
    centres.into_iter().map(Point::from).collect()
}

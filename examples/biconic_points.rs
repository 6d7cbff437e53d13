//! Writes the points of recipes/biconic.csv: `cargo run --example biconic_points > recipes/biconic.csv`.

use std::io::{self, Write};

use regrind::surface::DefinedSurface;

/// Formula and outline of the surface. recipes/biconic.toml has the same numbers for the simulator.
const SURFACE: &str = "\
[surface]
kind = 'biconic'
radius_x_mm = 140.0
radius_y_mm = 90.0
conic_x = -0.5
conic_y = 0.3
[aperture]
kind = 'rectangle'
width_mm = 60.0
height_mm = 44.0
";

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let surface = DefinedSurface::from_toml(SURFACE)?;
    let mut out = io::stdout().lock();
    writeln!(
        out,
        "# Biconic of radii 140 and 90 mm, conic constants -0.5 and 0.3; millimetres, to the picometre\nx,y,z"
    )?;
    for row in -22..=22 {
        for column in -30..=30 {
            let (x, y) = (f64::from(column), f64::from(row));
            let z = surface.formula().sag(x, y).ok_or("the formula ends within the part")?;
            writeln!(out, "{x},{y},{z:.9}")?;
        }
    }
    Ok(())
}

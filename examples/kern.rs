#![allow(missing_docs)]
use regrind::geometry::Point;
use regrind::surface::*;
use regrind_sim::shape::{FreeForm, Shape};
fn main() {
    let reps: usize = std::env::args().nth(1).unwrap().parse().unwrap();
    let shape = FreeForm::default();
    let pts: Vec<Point> = shape.grid(102.0, 62.0, 226, 126).into_iter().map(Point::from).collect();
    let m: Vec<Point> = pts
        .iter()
        .map(|p| {
            let n = shape.normal(p.x + 0.1, p.y + 0.07);
            let s = shape.point(p.x + 0.1, p.y + 0.07);
            Point::new(s[0] + 1.5 * n[0], s[1] + 1.5 * n[1], s[2] + 1.5 * n[2])
        })
        .collect();
    let n = Nominal::from_points(pts, Projection::Auto).unwrap();
    let s = OffsetSurface::new(&n, 1.5, Side::Normal).unwrap();
    let mut places: Vec<Place> = m.iter().map(|p| s.foot(p, Place::UNKNOWN).place).collect();
    let mut sum = 0.0;
    for _ in 0..reps {
        for (p, q) in m.iter().zip(&mut places) {
            let f = s.foot(p, *q);
            *q = f.place;
            sum += f.distance_mm;
        }
    }
    println!("{sum}");
}

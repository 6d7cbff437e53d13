//! The list of what is to be touched, as a part program reads it: rows of `index,x,y,z,nx,ny,nz,what` under comments and a header.

use crate::Vec3;
use crate::payload::Feature;

/// Something to be touched.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Target {
    /// Its number.
    pub index: u32,
    /// Where.
    pub point_mm: Vec3,
    /// The outward unit normal there.
    pub normal: Vec3,
    /// What it belongs to.
    pub feature: Feature,
}

/// A list.
#[derive(Clone, Debug, PartialEq)]
pub struct List {
    /// The comments above it, which tell one list from another.
    pub about: Vec<String>,
    /// The targets in their order.
    pub targets: Vec<Target>,
}

impl List {
    /// Reads a list; none where a row is no target, or there is no row.
    pub fn read(text: &str) -> Option<Self> {
        let (about, rows): (Vec<&str>, Vec<&str>) = text.lines().partition(|line| line.starts_with('#'));
        let rows = rows.into_iter().filter(|row| !row.starts_with("index"));
        let targets: Option<Vec<Target>> = rows.map(target).collect();
        let targets = targets.filter(|targets| !targets.is_empty())?;
        Some(Self { about: about.into_iter().map(str::to_owned).collect(), targets })
    }
}

fn target(row: &str) -> Option<Target> {
    let numbers: Option<Vec<f64>> = row.split(',').map(|field| field.trim().parse().ok()).collect();
    let [index, x, y, z, nx, ny, nz, what] = numbers?[..] else { return None };
    let feature = if what == 2.0 { Feature::ReferenceSphere } else { Feature::Part };
    Some(Target { index: index as u32, point_mm: [x, y, z], normal: [nx, ny, nz], feature })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_list_is_its_rows_and_half_a_list_is_none() {
        let text = "# job: 3\nindex,x,y,z,nx,ny,nz,what\n7,1,2,3,0,0,1,1\n8,4,5,6,1,0,0,2\n";
        let list = List::read(text).unwrap();
        assert_eq!(list.targets[0].point_mm, [1.0, 2.0, 3.0]);
        assert_eq!((list.targets[1].index, list.targets[1].feature), (8, Feature::ReferenceSphere));
        assert_eq!(List::read(&text[..text.len() - 4]), None);
        assert_eq!(List::read("# nothing\n"), None);
    }
}

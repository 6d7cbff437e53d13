//! List of targets, as a part program reads it: rows of `index,x,y,z,nx,ny,nz,what` after comments and a header.

use crate::payload::{Feature, Target};

/// List of targets.
#[derive(Clone, Debug, PartialEq)]
pub struct List {
    /// Comments above the rows; they distinguish one list from another.
    pub about: Vec<String>,
    /// Targets in their order.
    pub targets: Vec<Target>,
}

impl List {
    /// Parses a list of targets (`plan.csv`). Each row has eight numbers: index, x, y, z, nx, ny, nz, what. The value 2
    /// of `what` means the reference sphere. Lines with `#` and the header are not rows. Returns `None` if a row is
    /// invalid, or if there are no rows.
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
    fn target_list_refuses_truncation() {
        let text = "# job: 3\nindex,x,y,z,nx,ny,nz,what\n7,1,2,3,0,0,1,1\n8,4,5,6,1,0,0,2\n";
        let list = List::read(text).unwrap();
        assert_eq!(list.targets[0].point_mm, [1.0, 2.0, 3.0]);
        assert_eq!((list.targets[1].index, list.targets[1].feature), (8, Feature::ReferenceSphere));
        assert_eq!(List::read(&text[..text.len() - 4]), None);
        assert_eq!(List::read("# nothing\n"), None);
    }
}

//! Outlines of a face, joined from its edges.

use std::collections::HashMap;

use regrind_core::geometry::Point;

/// Places along an edge, in the sense in which an outline passes it.
pub(super) struct EdgePlaces {
    /// Number of the edge; an edge that a face has twice is a seam.
    pub edge: u64,
    /// Numbers of the vertices at its begin and its end.
    pub ends: [u64; 2],
    /// Places from the first vertex to the last, both included.
    pub places: Vec<Point>,
}

/// Joins the edges of a face to closed outlines. Seams are left out. Returns `None` if an outline does not close.
pub(super) fn joined_outlines(edges: Vec<EdgePlaces>) -> Option<Vec<Vec<Point>>> {
    let mut uses: HashMap<u64, usize> = HashMap::new();
    for edge in &edges {
        *uses.entry(edge.edge).or_default() += 1;
    }
    let single = edges.into_iter().filter(|edge| uses[&edge.edge] == 1);
    let mut rest: Vec<Option<EdgePlaces>> = single.map(Some).collect();
    // Edges by the vertex at their begin, the first of the face last, so that it is the next to be popped.
    let mut beginning: HashMap<u64, Vec<usize>> = HashMap::new();
    for (at, edge) in rest.iter().enumerate().rev() {
        if let Some(edge) = edge {
            beginning.entry(edge.ends[0]).or_default().push(at);
        }
    }
    let mut outlines = Vec::new();
    for at in 0..rest.len() {
        let Some(first) = rest[at].take() else { continue };
        let (begin, mut end) = (first.ends[0], first.ends[1]);
        let mut places = first.places;
        while end != begin {
            let edge = next_edge(&mut beginning, &mut rest, end)?;
            end = edge.ends[1];
            places.pop();
            places.extend(edge.places);
        }
        places.pop();
        outlines.push(places);
    }
    Some(outlines)
}

/// Takes the first edge that begins at a vertex.
fn next_edge(
    beginning: &mut HashMap<u64, Vec<usize>>,
    rest: &mut [Option<EdgePlaces>],
    vertex: u64,
) -> Option<EdgePlaces> {
    let there = beginning.get_mut(&vertex)?;
    while let Some(at) = there.pop() {
        if let Some(edge) = rest[at].take() {
            return Some(edge);
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    fn edge(edge: u64, ends: [u64; 2]) -> EdgePlaces {
        let place = |n: u64| Point::new(n as f64, edge as f64, 0.0);
        EdgePlaces { edge, ends, places: vec![place(ends[0]), place(ends[1])] }
    }

    #[test]
    fn edges_in_any_order_make_one_outline() {
        let outlines = joined_outlines(vec![edge(1, [1, 2]), edge(3, [3, 1]), edge(2, [2, 3])]).unwrap();
        assert_eq!(outlines.iter().map(Vec::len).collect::<Vec<_>>(), [3]);
        assert_eq!(outlines[0].iter().map(|p| p.y).collect::<Vec<_>>(), [1.0, 2.0, 3.0]);
    }

    #[test]
    fn seam_separates_two_circles() {
        // A cylinder: circle, seam up, circle, seam down.
        let edges = vec![edge(1, [1, 1]), edge(2, [1, 2]), edge(3, [2, 2]), edge(2, [2, 1])];
        assert_eq!(joined_outlines(edges).unwrap().len(), 2);
        assert!(joined_outlines(vec![edge(1, [1, 2]), edge(2, [2, 3])]).is_none());
        assert!(joined_outlines(Vec::new()).unwrap().is_empty());
    }
}

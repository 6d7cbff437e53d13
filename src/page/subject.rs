//! Subject of a page: one cell, or a plant.

/// Subject of a page. It decides the links at the top of the page.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PageSubject {
    /// One cell and its runs.
    Cell,
    /// All cells of a plant. This page is in English.
    Plant,
}

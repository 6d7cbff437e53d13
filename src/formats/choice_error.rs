//! Reasons why no surface of a file can be chosen: a face of a CAD model, or a surface of a lens.

use regrind_core::surface::analytic::DefinitionError;
use regrind_core::surface::parametric::FaceError;
use thiserror::Error;

/// Reason why no surface of a file can be chosen.
#[derive(Clone, Debug, Error, PartialEq)]
#[allow(missing_docs)]
#[non_exhaustive]
pub enum ChoiceError {
    /// No surface has the number.
    #[error("there is no face {number}; the faces have the numbers 1 to {count}: `regrind accuracy` lists them")]
    NoNumber { number: usize, count: usize },
    /// A lens has no surface of the number.
    #[error("the lens has no surface {number}; it has the surfaces {}: `regrind accuracy` lists them", list(.numbers))]
    NoSurface { number: usize, numbers: Vec<usize> },
    /// No surface has the name.
    #[error("nothing has the name `{name}`; {}", names_there(.names))]
    NoName { name: String, names: Vec<String> },
    /// Several surfaces have the name.
    #[error("several have the name `{name}`; choose one by its number: {}", list(.numbers))]
    SeveralOfName { name: String, numbers: Vec<usize> },
    /// The word is the number of one surface and the name of others.
    #[error("{number} is a number, and the name of number {}; choose `number:{number}` or `name:{number}`", list(.named))]
    NumberIsName { number: usize, named: Vec<usize> },
    /// The surface cannot be read.
    #[error("number {number}, {kind}, cannot be the nominal surface: {reason}")]
    Unreadable { number: usize, kind: String, reason: String },
    /// The largest face is not known, because a face cannot be read.
    #[error(
        "the area of face {number}, {kind}, is not known, so it is not known which face is the largest: {reason}; \
         choose a face by its number: `regrind accuracy` lists them"
    )]
    UnknownArea { number: usize, kind: String, reason: String },
    /// No face is clearly the largest.
    #[error("several faces are about as large as the largest; choose one by its number: {}", list(.numbers))]
    SeveralLargest { numbers: Vec<usize> },
    /// No face has an area.
    #[error("no face of the file has an outline that encloses an area; choose one by its number and give an aperture")]
    NoArea,
    /// A lens has several surfaces, and none was chosen.
    #[error("the lens has several curved surfaces; choose one by its number: {}", list(.numbers))]
    SeveralSurfaces { numbers: Vec<usize> },
    /// The surface has no outline in the file.
    #[error("surface {number} has no outline in the file; give the outline of the part as the aperture")]
    NoOutline { number: usize },
    /// A lens has no curved surface.
    #[error("the lens has no curved surface; choose a plane one by its number")]
    NoCurvedSurface,
    /// The file has one surface only, or none to choose from.
    #[error("the file has no faces to choose from; remove the choice of a face")]
    NothingToChoose,
    /// A frame was chosen for a surface that has none of its own.
    #[error("only a face of a CAD model has a frame of its own; remove the choice of the frame")]
    NoFrame,
    /// A sampling was chosen for points, for a mesh, or for a definition that states its own.
    #[error("only a face of a CAD model is sampled as this says; remove the sampling")]
    NoSampling,
    /// The face is no surface over x and y.
    #[error("face {number}: {source}")]
    Face { number: usize, source: FaceError },
    /// The surface of the file is not valid.
    #[error(transparent)]
    Definition(#[from] DefinitionError),
}

/// Returns the number, counted from 1, of the only one of `names` that is `name`.
pub(super) fn number_of(name: &str, names: &[&str]) -> Result<usize, ChoiceError> {
    let numbers: Vec<usize> = (1..).zip(names).filter(|(_, other)| **other == name).map(|(number, _)| number).collect();
    match numbers[..] {
        [number] => Ok(number),
        [] => {
            let mut there: Vec<String> =
                names.iter().filter(|name| !name.is_empty()).map(ToString::to_string).collect();
            there.sort();
            there.dedup();
            Err(ChoiceError::NoName { name: name.to_owned(), names: there })
        }
        _ => Err(ChoiceError::SeveralOfName { name: name.to_owned(), numbers }),
    }
}

/// Returns an error if a surface has the name `number`, but another number. `surfaces` are all numbers and names.
pub(super) fn check_is_no_name<'a>(
    number: usize,
    surfaces: impl Iterator<Item = (usize, &'a str)>,
) -> Result<(), ChoiceError> {
    let word = number.to_string();
    let named: Vec<usize> =
        surfaces.filter(|(own, name)| *own != number && *name == word).map(|(own, _)| own).collect();
    if named.is_empty() { Ok(()) } else { Err(ChoiceError::NumberIsName { number, named }) }
}

/// Maximum number of names or numbers in a message.
const MAX_LISTED: usize = 20;

fn list(numbers: &[usize]) -> String {
    let words: Vec<String> = numbers.iter().take(MAX_LISTED).map(ToString::to_string).collect();
    let more = numbers.len().saturating_sub(MAX_LISTED);
    if more > 0 { format!("{} and {more} more", words.join(", ")) } else { words.join(", ") }
}

fn names_there(names: &[String]) -> String {
    let more = names.len().saturating_sub(MAX_LISTED);
    match names {
        [] => "nothing in the file has a name: choose by number".to_owned(),
        names if more == 0 => format!("there are {}", names.join(", ")),
        names => format!("there are {} and {more} more", names[..MAX_LISTED].join(", ")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn number_is_no_name_of_another() {
        let surfaces = [(1, "2"), (2, ""), (3, "3"), (5, "2")];
        let check = |number| check_is_no_name(number, surfaces.into_iter());
        assert_eq!([1, 3, 4].map(check), [Ok(()), Ok(()), Ok(())]);
        assert_eq!(check(2), Err(ChoiceError::NumberIsName { number: 2, named: vec![1, 5] }));
    }

    #[test]
    fn name_must_be_there_once() {
        let names = ["", "a", "b", "a"];
        assert_eq!(number_of("b", &names), Ok(3));
        assert_eq!(number_of("a", &names), Err(ChoiceError::SeveralOfName { name: "a".into(), numbers: vec![2, 4] }));
        let missing = ChoiceError::NoName { name: "c".into(), names: vec!["a".into(), "b".into()] };
        assert_eq!(number_of("c", &names), Err(missing));
    }
}

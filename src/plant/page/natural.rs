//! Natural order of names: numbers within names are compared as numbers, so that `cell-2` comes before `cell-10`.

use std::cmp::Ordering;

/// Compares two names in natural order. Letters are compared without regard to case. Names that differ only in case or
/// in leading zeros still have an order, so that each name has a stable place.
pub(super) fn natural_order(a: &str, b: &str) -> Ordering {
    let (mut left, mut right) = (a, b);
    while !left.is_empty() && !right.is_empty() {
        let [(from, left_rest), (to, right_rest)] = [left, right].map(first_run);
        let is_number = |run: &str| run.starts_with(|c: char| c.is_ascii_digit());
        let order = match (is_number(from), is_number(to)) {
            (true, true) => {
                let [from, to] = [from, to].map(|digits| digits.trim_start_matches('0'));
                from.len().cmp(&to.len()).then_with(|| from.cmp(to))
            }
            _ => from.to_lowercase().cmp(&to.to_lowercase()),
        };
        if order != Ordering::Equal {
            return order;
        }
        (left, right) = (left_rest, right_rest);
    }
    left.len().cmp(&right.len()).then_with(|| a.cmp(b))
}

/// Splits a text after its first run of digits, or of characters that are no digits.
fn first_run(text: &str) -> (&str, &str) {
    let is_number = text.starts_with(|c: char| c.is_ascii_digit());
    text.split_at(text.find(|c: char| c.is_ascii_digit() != is_number).unwrap_or(text.len()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_in_names_order_as_numbers() {
        let ordered =
            ["", "2", "10", "Cell-1", "cell-01", "cell-1", "cell-2", "cell-2b", "cell-10", "cell-10-9", "cell-10-10"];
        let mut found = ordered;
        found.reverse();
        found.sort_by(|a, b| natural_order(a, b));
        assert_eq!(
            found,
            ["", "2", "10", "Cell-1", "cell-01", "cell-1", "cell-2", "cell-2b", "cell-10", "cell-10-9", "cell-10-10"]
        );
        // Longer than any integer type, and not ASCII.
        assert_eq!(natural_order(&"9".repeat(60), &format!("1{}", "0".repeat(60))), Ordering::Less);
        assert_eq!(natural_order("单元2", "单元10"), Ordering::Less);
        assert_eq!(natural_order("\u{e9}1", "\u{e9}1"), Ordering::Equal);
    }
}

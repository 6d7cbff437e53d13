//! Formats in which a machine prints a touch.

use crate::Vec3;

/// Format of a line.
#[derive(Clone, Debug, PartialEq)]
pub struct Style {
    /// True if the letter of the axis is in front of each number.
    pub letters: bool,
    /// True if coordinates are whole micrometres, and angles whole tenths of a degree.
    pub whole: bool,
    /// Angle of the rotary table, if it is printed.
    pub rotary_deg: Option<f64>,
    /// Number of decimals.
    pub decimals: usize,
    /// Decimal mark.
    pub mark: char,
    /// Separator of two values.
    pub separator: char,
    /// Length of the unit, in mm.
    pub unit_mm: f64,
    /// Axis of each value.
    pub axes: [usize; 3],
}

impl Default for Style {
    fn default() -> Self {
        let (decimals, mark, separator, unit_mm, axes) = (3, '.', ',', 1.0, [0, 1, 2]);
        Self { letters: false, whole: false, rotary_deg: None, decimals, mark, separator, unit_mm, axes }
    }
}

impl Style {
    /// Returns the line that is printed for a touch at `at_mm`, with its line end.
    pub fn line(&self, at_mm: Vec3) -> Vec<u8> {
        let value = |k: usize| match self.whole {
            true => format!("{}", (at_mm[self.axes[k]] * 1e3).round() as i64),
            false => {
                let text = format!("{:.*}", self.decimals, at_mm[self.axes[k]] / self.unit_mm);
                text.replace('.', &self.mark.to_string())
            }
        };
        let angle = self.rotary_deg.map(|angle| match self.whole {
            true => format!("{}", (angle * 10.0).round() as i64),
            false => format!("{angle:.1}").replace('.', &self.mark.to_string()),
        });
        let values: Vec<String> = (0..3).map(value).chain(angle).collect();
        let lettered = values.iter().zip("XYZW".chars()).map(|(value, letter)| match self.letters {
            true => format!("{letter}{value}"),
            false => value.clone(),
        });
        let line = lettered.collect::<Vec<_>>().join(&self.separator.to_string());
        (line + "\r\n").into_bytes()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hit_line_prints_eight_formats() {
        for (letters, whole, rotary_deg, line) in [
            (false, false, None, "100.000,200.000,300.000\r\n"),
            (false, true, None, "100000,200000,300000\r\n"),
            (true, false, None, "X100.000,Y200.000,Z300.000\r\n"),
            (true, true, None, "X100000,Y200000,Z300000\r\n"),
            (false, false, Some(245.5), "100.000,200.000,300.000,245.5\r\n"),
            (false, true, Some(245.5), "100000,200000,300000,2455\r\n"),
            (true, false, Some(245.5), "X100.000,Y200.000,Z300.000,W245.5\r\n"),
            (true, true, Some(245.5), "X100000,Y200000,Z300000,W2455\r\n"),
        ] {
            let style = Style { letters, whole, rotary_deg, ..Style::default() };
            assert_eq!(String::from_utf8(style.line([100.0, 200.0, 300.0])).unwrap(), line);
        }
        let style = Style { mark: ',', separator: ';', axes: [2, 0, 1], ..Style::default() };
        assert_eq!(style.line([-1.5, 0.0004, 3.0]), b"3,000;-1,500;0,000\r\n");
    }
}

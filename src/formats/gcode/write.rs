//! Writing a program for LinuxCNC and its kin, a move a line, as fast as a file takes it.

use std::fmt::Write as _;
use std::path::Path;

use rayon::prelude::*;

use super::number::{LARGEST_MM, push_fixed, rounded, short};
use super::{GcodeError, hex};
use crate::registration::Draft;
use regrind_core::compensation::path::{Move, PathMode, Summary, ToolPath};

/// Bytes that are gathered before they go to the file.
const CHUNK: usize = 1 << 16;
/// Points whose lines are made at the same time and wait for their turn, some 30 bytes each.
const AT_ONCE: u64 = 200_000;

/// What the header of a program without a correction says of its map.
pub(super) const UNCORRECTED: &str = "map: 0 everywhere";

/// What the header of a program tells.
#[derive(Clone, Debug)]
pub struct ProgramHeader {
    /// The part by name.
    pub part: String,
    /// The pass, from 1.
    pub cycle: u16,
    /// SHA-256 of what the nominal surface came from: what the path was made over.
    pub base_identity: [u8; 32],
    /// Identity of the correction that is in the path.
    pub map_identity: [u8; 32],
    /// Whether that is 0 everywhere.
    pub uncorrected: bool,
    /// Height of the surface wanted over the nominal one, in millimetres.
    pub level_mm: f64,
    /// The wheel in words.
    pub wheel: String,
    /// Which parameters of the machine are taken back in the path, a line each.
    pub parameters: Vec<String>,
    /// The tracks in words.
    pub tracks: String,
    /// How often the program is run again without going deeper.
    pub spark_out_passes: u16,
    /// Whether the cell is simulated.
    pub simulation: bool,
    /// How exactly the controller keeps to the path.
    pub mode: PathMode,
    /// How far it may round corners off with [`PathMode::Blend`], in millimetres.
    pub path_tolerance_mm: f64,
}

/// Writes a program: the header, the moves track by track, the end.
///
/// Frame: the model frame, which G54 must have its zero in. Units: mm, mm/min. A coordinate that does not change within a track is left
/// out; every track says all of its beginning anew, so that a program can be gone on with at any of them, and many are written at the same
/// time. The file appears whole or not at all.
///
/// # Errors
/// A coordinate that is not finite or beyond a kilometre; a number of moves other than the summary has; a file that cannot be written.
pub fn write_program(
    file: &Path,
    header: &ProgramHeader,
    summary: &Summary,
    path: &ToolPath,
) -> Result<(), GcodeError> {
    write_tracks(file, header, summary, &path.moves_by_track())
}

fn write_tracks<T>(path: &Path, header: &ProgramHeader, summary: &Summary, tracks: &[T]) -> Result<(), GcodeError>
where
    T: Iterator<Item = Move> + Clone + Sync,
{
    let mut draft = Draft::create(path)?;
    draft.write(header_text(header, summary).as_bytes())?;
    let mut count = 0;
    let at_once = (AT_ONCE * tracks.len() as u64 / summary.points.max(1)) as usize;
    if at_once < 2 {
        // Long tracks go to the file as they come.
        for track in tracks {
            let mut lines = Lines::new(count);
            for one in track.clone() {
                lines.push(&one)?;
                if lines.text.len() >= CHUNK {
                    draft.write(&lines.text)?;
                    lines.text.clear();
                }
            }
            draft.write(&lines.text)?;
            count = lines.count;
        }
    } else {
        for some in tracks.chunks(at_once) {
            let texts: Vec<Result<Lines, GcodeError>> = some.par_iter().map(Lines::of).collect();
            for lines in texts {
                let lines = lines.map_err(|error| error.after(count))?;
                draft.write(&lines.text)?;
                count += lines.count;
            }
        }
    }
    if count != summary.moves {
        return Err(GcodeError::Count { found: count, expected: summary.moves });
    }
    draft.write(b"M2\n")?;
    draft.publish()?;
    Ok(())
}

/// The lines of the moves, and what is in force after them.
struct Lines {
    text: Vec<u8>,
    last: [i64; 3],
    mode: Option<u8>,
    /// In millionths.
    feed: i64,
    count: u64,
}

impl Lines {
    /// Nothing is in force, after so many moves.
    fn new(count: u64) -> Self {
        Self { text: Vec::new(), last: [i64::MAX; 3], mode: None, feed: 0, count }
    }

    /// The lines of a whole track.
    fn of<T: Iterator<Item = Move> + Clone>(track: &T) -> Result<Self, GcodeError> {
        let mut lines = Self::new(0);
        track.clone().try_for_each(|one| lines.push(&one))?;
        Ok(lines)
    }

    #[inline]
    fn push(&mut self, one: &Move) -> Result<(), GcodeError> {
        self.count += 1;
        match one {
            Move::RapidZ(z) => {
                self.mode(b'0');
                self.word(2, *z)?;
            }
            Move::RapidXy([x, y]) => {
                self.mode(b'0');
                self.word(0, *x)?;
                self.word(1, *y)?;
            }
            Move::Feed { at, feed_mm_min } => {
                self.mode(b'1');
                for k in 0..3 {
                    self.word(k, at[k])?;
                }
                let feed = rounded(*feed_mm_min);
                if feed != self.feed {
                    self.feed = feed;
                    self.text.push(b'F');
                    self.text.extend_from_slice(short(*feed_mm_min).as_bytes());
                }
            }
        }
        self.text.push(b'\n');
        Ok(())
    }

    #[inline]
    fn mode(&mut self, mode: u8) {
        if self.mode != Some(mode) {
            self.mode = Some(mode);
            self.text.extend_from_slice(&[b'G', mode, b' ']);
        }
    }

    #[inline]
    fn word(&mut self, axis: usize, value_mm: f64) -> Result<(), GcodeError> {
        if value_mm.is_nan() || value_mm.abs() > LARGEST_MM {
            return Err(GcodeError::NotFinite { axis: ['X', 'Y', 'Z'][axis], value_mm, number: self.count });
        }
        let value = rounded(value_mm);
        if value != self.last[axis] {
            self.last[axis] = value;
            self.text.push([b'X', b'Y', b'Z'][axis]);
            push_fixed(&mut self.text, value);
        }
        Ok(())
    }
}

/// The header, with the number of its own lines counted in.
fn header_text(header: &ProgramHeader, summary: &Summary) -> String {
    let without = header_lines(header, summary, 0);
    let lines = without.lines().count() as u64 + summary.moves + 1;
    header_lines(header, summary, lines)
}

fn header_lines(h: &ProgramHeader, s: &Summary, lines: u64) -> String {
    let mut text = String::new();
    let mut say = |words: std::fmt::Arguments| {
        // Writing to a string does not fail.
        let _ = writeln!(text, "({})", comment(&words.to_string()));
    };
    if h.simulation {
        say(format_args!("SIMULATION"));
    }
    say(format_args!("Regrind {} tool path", env!("CARGO_PKG_VERSION")));
    say(format_args!("part: {}", h.part));
    say(format_args!("part: sha256 {}", hex(&h.base_identity)));
    say(format_args!("cycle: {}", h.cycle));
    say(format_args!("base: sha256 {}", hex(&h.base_identity)));
    say(format_args!("map: sha256 {}", hex(&h.map_identity)));
    if h.uncorrected {
        say(format_args!("{UNCORRECTED}"));
    }
    say(format_args!("frame: model, z away from the part; G54 has its zero in the origin of the model"));
    say(format_args!("units: mm, mm/min; a correction is positive where it leaves material, along the outward normal"));
    say(format_args!("level over the nominal surface: {} mm", short(h.level_mm)));
    say(format_args!("wheel: {}", h.wheel));
    for taken in &h.parameters {
        say(format_args!("parameter: {taken}"));
    }
    say(format_args!("tracks: {}", h.tracks));
    say(format_args!("feed: {} mm/min", short(s.feed_mm_min)));
    say(format_args!("spark-out: the program is run {} times more", h.spark_out_passes));
    for (k, axis) in ['X', 'Y', 'Z'].into_iter().enumerate() {
        say(format_args!("limits: {axis} {} to {} mm", short(s.least_mm[k]), short(s.most_mm[k])));
    }
    say(format_args!("length: {} mm at feed, {:.1} minutes", short(s.length_mm.round()), s.seconds / 60.0));
    say(format_args!("points: {}", s.points));
    say(format_args!("lines: {lines}"));
    say(format_args!("spindle and coolant are the machine's own; start them before"));
    // LinuxCNC's default at power-on is G64 without a tolerance, which cuts corners by a tenth of a millimetre and more: a program must say.
    let mode = match h.mode {
        PathMode::Blend => format!("G64 P{} Q0", short(h.path_tolerance_mm)),
        PathMode::ExactPath => "G61".into(),
        PathMode::ExactStop => "G61.1".into(),
    };
    let _ = writeln!(text, "G21 G90 G94 G17 G40 G49 G80 G54\n{mode}");
    text
}

/// Returns words that may stand in a comment: no brackets, which would end it or begin another, and plain characters.
pub(super) fn comment(words: &str) -> String {
    let plain = |c: char| match c {
        '(' => '[',
        ')' => ']',
        ' '..='~' => c,
        _ => '?',
    };
    words.chars().map(plain).take(200).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use regrind_core::compensation::path::Peak;
    use regrind_core::geometry::Point;

    /// Along x there and back, one track after the other.
    fn tracks(count: usize) -> Vec<std::vec::IntoIter<Move>> {
        let feed = |x: f64, y: f64| Move::Feed { at: Point::new(x, y, 0.1 * y), feed_mm_min: 600.0 };
        let track = |k: usize| {
            let (y, turn) = (k as f64, if k.is_multiple_of(2) { 1.0 } else { -1.0 });
            let (over, up) = (Move::RapidXy([-turn, y]), Move::RapidZ(5.0));
            vec![over, Move::RapidZ(1.0), feed(-turn, y), feed(turn, y), up].into_iter()
        };
        (0..count).map(track).collect()
    }

    fn write(tracks: &[std::vec::IntoIter<Move>], points: u64) -> Result<String, GcodeError> {
        let header = ProgramHeader {
            part: "part".into(),
            cycle: 1,
            base_identity: [1; 32],
            map_identity: [2; 32],
            uncorrected: false,
            level_mm: 0.0,
            wheel: "ball".into(),
            parameters: Vec::new(),
            tracks: "raster".into(),
            spark_out_passes: 0,
            simulation: true,
            mode: PathMode::Blend,
            path_tolerance_mm: 1e-4,
        };
        let summary = Summary {
            moves: 5 * tracks.len() as u64,
            points,
            least_mm: [0.0; 3],
            most_mm: [0.0; 3],
            length_mm: 0.0,
            rapid_mm: 0.0,
            seconds: 0.0,
            speed_mm_s: [Peak::default(); 3],
            acceleration_mm_s2: Peak::default(),
            feed_mm_min: 600.0,
            run_up_mm: 0.0,
        };
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("part.ngc");
        write_tracks(&file, &header, &summary, tracks)?;
        let text = std::fs::read_to_string(file).unwrap();
        Ok(text[text.find("G54").unwrap()..].to_owned())
    }

    #[test]
    fn every_track_says_all_of_its_beginning() {
        let text = write(&tracks(2), 4).unwrap();
        let lines: Vec<&str> = text.lines().skip_while(|line| !line.starts_with("G0")).collect();
        let first = ["G0 X-1.000000Y0.000000", "Z1.000000", "G1 Z0.000000F600", "X1.000000", "G0 Z5.000000"];
        let second = ["G0 X1.000000Y1.000000", "Z1.000000", "G1 Z0.100000F600", "X-1.000000", "G0 Z5.000000"];
        assert_eq!(lines, [&first[..], &second, &["M2"]].concat());
    }

    #[test]
    fn tracks_that_are_written_at_the_same_time_are_the_same_text() {
        let many = tracks(1000);
        let after_header = |text: String| text[text.find("G0").unwrap()..].to_owned();
        let [at_once, one_by_one] = [2000, u64::MAX].map(|points| after_header(write(&many, points).unwrap()));
        assert!(at_once == one_by_one && at_once.lines().count() == 5001);
        // A few at a time, with some left over.
        let some = after_header(write(&many, AT_ONCE * 1000 / 7).unwrap());
        assert!(some == at_once);
    }

    #[test]
    fn what_is_no_number_is_told_by_its_place_in_the_whole() {
        let mut many = tracks(1000);
        let broken = Move::Feed { at: Point::new(0.0, f64::NAN, 0.0), feed_mm_min: 600.0 };
        many[700] = vec![Move::RapidZ(5.0), broken].into_iter();
        for points in [2000, u64::MAX, AT_ONCE * 1000 / 7] {
            let error = write(&many, points).unwrap_err();
            assert!(matches!(error, GcodeError::NotFinite { axis: 'Y', number: 3502, .. }), "{error}");
        }
        assert!(write(&tracks(2)[..1], 1).is_ok());
        let short = vec![vec![Move::RapidZ(5.0)].into_iter()];
        assert!(matches!(write(&short, 1), Err(GcodeError::Count { found: 1, expected: 5 })));
    }
}

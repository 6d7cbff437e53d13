//! Writing of a program in the dialect of a control, one move per block, at the speed of the file.

use std::path::Path;

use data_encoding::HEXLOWER;
use rayon::prelude::*;

use super::GcodeError;
use super::dialect::{ArcWords, CentreWords, Dialect, Exactness, LineEnd, NAME, NUMBER, Post};
use super::number::{push_decimals, short};
use crate::registration::Draft;
use regrind_core::compensation::path::{
    Arc, ArcSummary, Move, PathSummary, Plane, ProgramBlock, RotaryAxis, RotationAxis, ToolPath,
};

/// Bytes that are collected before they are written to the file.
const CHUNK: usize = 1 << 16;
/// Number of points whose lines are formatted in parallel and then wait to be written, some 30 bytes each.
const AT_ONCE: u64 = 200_000;

/// Text in the header of a program without a correction, in place of the identity of a map.
pub(super) const UNCORRECTED: &str = "map: 0 everywhere";

/// Content of the header of a program.
#[derive(Clone, Debug)]
pub struct ProgramHeader {
    /// Name of the part.
    pub part: String,
    /// Number of the pass, from 1.
    pub cycle: u16,
    /// SHA-256 of the source of the nominal surface for which the path was computed.
    pub base_identity: [u8; 32],
    /// Identity of the correction that is in the path.
    pub map_identity: [u8; 32],
    /// True if the correction in the path is 0 everywhere.
    pub uncorrected: bool,
    /// Height of the target surface above the nominal one, in millimetres.
    pub level_mm: f64,
    /// True if the wheel comes from -z.
    pub from_below: bool,
    /// Rotary axis that tilts the wheel, if there is one.
    pub rotary: Option<RotaryAxis>,
    /// Tilt of the wheel, in words.
    pub lean: String,
    /// Description of the wheel, in words.
    pub wheel: String,
    /// Parameters of the machine that the path compensates, one line each.
    pub parameters: Vec<String>,
    /// Description of the tracks, in words.
    pub tracks: String,
    /// Number of times that the program is repeated without going deeper.
    pub spark_out_passes: u16,
    /// True if the cell is simulated.
    pub simulation: bool,
    /// Accuracy with which the control has to follow the path.
    pub exactness: Exactness,
}

/// Writes the program of a tool path to `file`: the header, then the moves track by track, then the end. `summary` is
/// the summary of the same `path`. The file appears complete or not at all.
///
/// Frame: the model frame; the work offset must have its zero in the origin of the model. Units: mm, mm/min. A
/// coordinate that does not change within a track is omitted. Every track states its complete start position again, so
/// that a program can be resumed at any track. Many short tracks are formatted in parallel, unless the blocks have
/// numbers.
///
/// # Errors
/// A request that the dialect cannot express; a coordinate that is not finite or exceeds the limit of the dialect; a
/// feed that rounds to 0; a number of moves that differs from the expected number; a file that cannot be written.
pub fn write_program(
    file: &Path,
    header: &ProgramHeader,
    dialect: &Dialect,
    summary: &PathSummary,
    path: &ToolPath,
) -> Result<(), GcodeError> {
    let post = dialect.post(&header.exactness)?;
    match &post.arcs {
        None => write_tracks(file, header, &post, (summary, None), &path.moves_by_track()),
        Some((_, options)) => {
            let arcs = path.arc_summary(options);
            write_tracks(file, header, &post, (summary, Some(&arcs)), &path.arcs_by_track(options))
        }
    }
}

fn write_tracks<T>(
    path: &Path,
    header: &ProgramHeader,
    post: &Post,
    (summary, arcs): (&PathSummary, Option<&ArcSummary>),
    tracks: &[T],
) -> Result<(), GcodeError>
where
    T: Iterator<Item: Into<ProgramBlock>> + Clone + Sync,
{
    let dialect = post.dialect;
    let frame = Frame::new(post, header)?;
    let (head, numbered) = frame.head(header, summary, arcs);
    let mut draft = Draft::create(path)?;
    draft.write(head.as_bytes())?;
    let rotary = header.rotary.as_ref();
    let mut lines = Lines::new(dialect, rotary, 0, numbered);
    let at_once = (AT_ONCE * tracks.len() as u64 / summary.points.max(1)) as usize;
    if at_once < 2 || dialect.blocks.is_some() {
        // Long tracks, and tracks whose blocks are numbered, are written to the file as they come.
        for track in tracks {
            lines.begin();
            for one in track.clone() {
                lines.push(&one.into())?;
                if lines.text.len() >= CHUNK {
                    draft.write(&lines.text)?;
                    lines.text.clear();
                }
            }
        }
        draft.write(&lines.text)?;
    } else {
        for some in tracks.chunks(at_once) {
            let texts: Vec<Result<Lines, GcodeError>> =
                some.par_iter().map(|track| Lines::format_track(dialect, rotary, track)).collect();
            for text in texts {
                let text = text.map_err(|error| error.after(lines.count))?;
                draft.write(&text.text)?;
                lines.count += text.count;
            }
        }
    }
    let expected = arcs.map_or(summary.moves, |arcs| arcs.moves);
    if lines.count != expected {
        return Err(GcodeError::Count { found: lines.count, expected });
    }
    draft.write(frame.tail(lines.numbered).as_bytes())?;
    draft.publish()?;
    Ok(())
}

/// Lines of the moves, and the modal state after them.
struct Lines<'a> {
    dialect: &'a Dialect,
    rotary: Option<&'a RotaryAxis>,
    text: Vec<u8>,
    /// Last coordinates, in units of the last written digit; `i64::MAX` if none is in force.
    last: [i64; 3],
    turned: i64,
    motion: Option<Motion>,
    plane: Option<Plane>,
    feed: i64,
    count: u64,
    /// Number of numbered blocks so far.
    numbered: u64,
    per_mm: f64,
    per_deg: f64,
    feed_per: f64,
}

/// Kind of motion of a block.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Motion {
    Rapid,
    Line,
    Clockwise,
    CounterClockwise,
}

/// Minimum length for which an inverse time is computed, in millimetres.
const MIN_LENGTH_MM: f64 = 1e-6;
/// Value of a position or a feed that is not in force.
const NOTHING: i64 = i64::MAX;

impl<'a> Lines<'a> {
    /// Creates an empty text for the blocks of moves. No motion, position or feed is active yet, so the first block
    /// states all of them. `rotary` is the rotary axis that tilts the wheel; `None` if there is none. `count` is the
    /// number of moves that come earlier in the program. `numbered` is the number of earlier blocks with a block
    /// number.
    fn new(dialect: &'a Dialect, rotary: Option<&'a RotaryAxis>, count: u64, numbered: u64) -> Self {
        let power = |decimals: u8| 10f64.powi(i32::from(decimals));
        let numbers = &dialect.numbers;
        let [per_mm, per_deg, feed_per] = [numbers.decimals, numbers.angle_decimals, numbers.feed_decimals].map(power);
        let (text, last, turned, feed) = (Vec::new(), [NOTHING; 3], NOTHING, NOTHING);
        let (motion, plane) = (None, None);
        Self { dialect, rotary, text, last, turned, motion, plane, feed, count, numbered, per_mm, per_deg, feed_per }
    }

    /// Formats all moves of one track into a new text. `rotary` is the rotary axis that tilts the wheel, if there is
    /// one.
    ///
    /// # Errors
    /// A coordinate or a feed that the dialect cannot express. The error states the number of the move, counted from
    /// the start of the track.
    fn format_track<T: Iterator<Item: Into<ProgramBlock>> + Clone>(
        dialect: &'a Dialect,
        rotary: Option<&'a RotaryAxis>,
        track: &T,
    ) -> Result<Self, GcodeError> {
        let mut lines = Self::new(dialect, rotary, 0, 0);
        track.clone().try_for_each(|one| lines.push(&one.into()))?;
        Ok(lines)
    }

    /// Clears the modal state, so that the next block states its motion, position and feed again.
    fn begin(&mut self) {
        (self.last, self.turned, self.feed) = ([NOTHING; 3], NOTHING, NOTHING);
        (self.motion, self.plane) = (None, None);
    }

    #[inline]
    fn push(&mut self, block: &ProgramBlock) -> Result<(), GcodeError> {
        self.count += 1;
        match block {
            ProgramBlock::Straight(one) => self.straight(one),
            ProgramBlock::Arc(arc) => self.arc(arc),
        }
    }

    /// Writes the number of the next block if the dialect numbers blocks, and counts the block in any case.
    #[inline]
    fn number(&mut self) {
        number(&mut self.text, self.dialect, self.numbered);
        self.numbered += 1;
    }

    #[inline]
    fn straight(&mut self, one: &Move) -> Result<(), GcodeError> {
        let words = &self.dialect.words;
        self.number();
        match one {
            Move::RapidZ(z) => self.block(true, [None, None, Some(*z)], None, None)?,
            Move::RapidXy([x, y]) => self.block(true, [Some(*x), Some(*y), None], None, None)?,
            Move::Feed { to: at, feed_mm_min } => {
                self.block(false, [Some(at.x), Some(at.y), Some(at.z)], None, Some(*feed_mm_min))?;
            }
            Move::RapidTilted { to_mm: [x, y], tilt_rad } => {
                self.block(true, [Some(*x), Some(*y), None], Some(*tilt_rad), None)?;
            }
            Move::FeedTilted { to: at, tilt_rad, feed_mm_min, centre_mm } => {
                let feed = self.feed_of(*feed_mm_min, *centre_mm);
                self.block(false, [Some(at.x), Some(at.y), Some(at.z)], Some(*tilt_rad), Some(feed))?;
            }
        }
        if matches!(one, Move::RapidZ(_) | Move::RapidXy(_) | Move::RapidTilted { .. }) {
            self.text.extend_from_slice(words.rapid_ends.as_bytes());
        }
        end_line(&mut self.text, self.dialect);
        Ok(())
    }

    /// Returns the feed in the form that the control expects. `feed_mm_min` is the feed of the wheel's centre, and
    /// `centre_mm` is the length of the move of the centre.
    ///
    /// If the control itself keeps the wheel's centre in place, the result is `feed_mm_min`. If the program moves the
    /// slides, the result is the inverse time: 1 divided by the duration of the block, in 1/min. An inverse time is
    /// valid for one block only, so the next block states a feed again.
    fn feed_of(&mut self, feed_mm_min: f64, centre_mm: f64) -> f64 {
        if !self.moves_slides() {
            return feed_mm_min;
        }
        self.feed = NOTHING;
        feed_mm_min / centre_mm.max(MIN_LENGTH_MM)
    }

    fn moves_slides(&self) -> bool {
        self.rotary.is_some_and(|rotary| rotary.pivot_mm.is_some())
    }

    /// Writes the block of a rapid or straight move without the end of the line. `rapid` is true for a rapid move.
    /// `to_mm` is the end position; an axis, a tilt or a feed that is `None` stays unchanged.
    ///
    /// A word whose value did not change is omitted. If no value changed, all axes whose position is known are written,
    /// so that the block is still a move.
    ///
    /// # Errors
    /// A value that is not finite or exceeds the limit of the dialect; a feed that rounds to 0.
    #[inline]
    fn block(
        &mut self,
        rapid: bool,
        to_mm: [Option<f64>; 3],
        tilt_rad: Option<f64>,
        feed_mm_min: Option<f64>,
    ) -> Result<(), GcodeError> {
        let words = &self.dialect.words;
        let (motion, begins) = if rapid { (Motion::Rapid, &words.rapid) } else { (Motion::Line, &words.line) };
        self.begins(motion, begins);
        let mut to = self.last;
        for (k, value_mm) in to_mm.iter().enumerate().filter_map(|(k, value)| Some((k, (*value)?))) {
            to[k] = self.rounded(k, value_mm)?;
        }
        let feed = feed_mm_min.map_or(Ok(self.feed), |feed| self.rounded_feed(feed))?;
        let turned = tilt_rad.map_or(Ok(self.turned), |tilt| self.rounded_turn(tilt))?;
        let still = to == self.last && turned == self.turned;
        // A block with only an inverse time would not be a move.
        let nothing_new = still && (feed == self.feed || self.moves_slides());
        let mut first = true;
        for (k, &value) in to.iter().enumerate() {
            if value != self.last[k] || (nothing_new && value != NOTHING) {
                self.place(&words.axes[k], value, &mut first);
            }
        }
        if let Some(rotary) = self.rotary.filter(|_| turned != self.turned) {
            self.between(&mut first);
            self.push_turn(rotary.letter, turned);
        }
        self.feed(feed, &mut first);
        (self.last, self.turned) = (to, turned);
        Ok(())
    }

    /// Writes the block of an arc. If the dialect states the centre in its own block, this block is written first. The
    /// end point in the plane of the arc and the centre are always written. The coordinate perpendicular to the plane
    /// is written only if it changed. Writes nothing if the dialect has no words for arcs.
    ///
    /// # Errors
    /// A value that is not finite or exceeds the limit of the dialect; a feed that rounds to 0.
    fn arc(&mut self, arc: &Arc) -> Result<(), GcodeError> {
        let dialect = self.dialect;
        let (words, Some(arcs)) = (&dialect.words, &dialect.arcs) else { return Ok(()) };
        let [a, b, c] = arc.plane.0;
        let mut to = self.last;
        for k in [a, b, c] {
            to[k] = self.rounded(k, arc.to[k])?;
        }
        let centre = [self.rounded(a, arc.centre_mm[0])?, self.rounded(b, arc.centre_mm[1])?];
        let feed = self.rounded_feed(arc.feed_mm_min)?;
        let mut first = true;
        if let (CentreWords::BlockBefore, Some(begins)) = (arcs.centre, &arcs.centre_block) {
            self.number();
            self.text.extend_from_slice(begins.as_bytes());
            self.centre(&words.axes, arc.plane, centre, &mut first);
            end_line(&mut self.text, dialect);
        }
        self.number();
        self.turn(arc, arcs);
        first = true;
        let last = self.last;
        for k in (0..3).filter(|k| *k != c || to[c] != last[c]) {
            self.place(&words.axes[k], to[k], &mut first);
        }
        if let Some(letters) = &arcs.centre_words {
            let from = if arcs.centre == CentreWords::FromStart { [last[a], last[b]] } else { [0; 2] };
            self.centre(letters, arc.plane, [centre[0] - from[0], centre[1] - from[1]], &mut first);
        }
        let ends = if arc.clockwise { &arcs.clockwise_ends } else { &arcs.counter_clockwise_ends };
        self.text.extend_from_slice(ends.as_bytes());
        self.feed(feed, &mut first);
        end_line(&mut self.text, dialect);
        self.last = to;
        Ok(())
    }

    /// Writes the words that begin an arc: the plane, if it changed, and the direction of rotation.
    fn turn(&mut self, arc: &Arc, arcs: &ArcWords) {
        if let Some(planes) = arcs.planes.as_ref().filter(|_| self.plane != Some(arc.plane)) {
            let known = [Plane::XY, Plane::ZX, Plane::YZ].iter().position(|plane| *plane == arc.plane);
            self.text.extend_from_slice(planes[known.unwrap_or(0)].as_bytes());
        }
        self.plane = Some(arc.plane);
        match arc.clockwise {
            true => self.begins(Motion::Clockwise, &arcs.clockwise),
            false => self.begins(Motion::CounterClockwise, &arcs.counter_clockwise),
        }
    }

    /// Writes the two coordinates of the centre of an arc, in the order x, y, z of their axes. `centre` holds the
    /// coordinates along the first and the second axis of `plane`, in units of the last written digit: 1234 is 1.234 mm
    /// if the dialect has three decimals. `letters` holds the text that is written before a coordinate along x, y and
    /// z, such as `I`, `J` and `K`. `first` is true if the block has no word yet. It becomes false.
    fn centre(&mut self, letters: &[String; 3], plane: Plane, centre: [i64; 2], first: &mut bool) {
        for (k, letter) in letters.iter().enumerate() {
            if let Some(at) = plane.0[..2].iter().position(|axis| *axis == k) {
                self.place(letter, centre[at], first);
            }
        }
    }

    /// Writes `words`, the text that selects the kind of motion `motion`, such as `G1`. Omits this text if the same
    /// kind of motion is already active, unless the dialect repeats the text in each block.
    #[inline]
    fn begins(&mut self, motion: Motion, words: &str) {
        if self.dialect.words.each_block || self.motion != Some(motion) {
            self.motion = Some(motion);
            self.text.extend_from_slice(words.as_bytes());
        }
    }

    /// Writes one coordinate of a block. `word` is the text of the axis, such as `X`. `value` is the coordinate in
    /// units of the last written digit: 1234 is 1.234 mm if the dialect has three decimals. `first` is true if the
    /// block has no word yet, and becomes false.
    #[inline]
    fn place(&mut self, word: &str, value: i64, first: &mut bool) {
        self.between(first);
        self.text.extend_from_slice(word.as_bytes());
        let numbers = &self.dialect.numbers;
        if numbers.plus && value >= 0 {
            self.text.push(b'+');
        }
        push_decimals(&mut self.text, value, numbers.decimals);
    }

    /// Writes the feed, unless the same feed is already active from an earlier block. `feed` is in units of the last
    /// written digit: 6005 is 600.5 if the dialect has one decimal for feeds. `first` is true if the block has no word
    /// yet. It becomes false if the feed is written.
    #[inline]
    fn feed(&mut self, feed: i64, first: &mut bool) {
        if feed != self.feed {
            self.between(first);
            self.text.extend_from_slice(self.dialect.words.feed.as_bytes());
            push_feed(&mut self.text, feed, self.dialect);
            self.feed = feed;
        }
    }

    #[inline]
    fn between(&mut self, first: &mut bool) {
        if !std::mem::replace(first, false) {
            self.text.extend_from_slice(self.dialect.words.between.as_bytes());
        }
    }

    /// Converts a coordinate to a whole number of units of the last written digit: 1.234 mm gives 1234 if the dialect
    /// has three decimals. `axis` is 0 for x, 1 for y, 2 for z, and names the axis in an error.
    ///
    /// # Errors
    /// A value that is not finite or exceeds the limit of the dialect.
    #[inline]
    fn rounded(&self, axis: usize, value_mm: f64) -> Result<i64, GcodeError> {
        let max_mm = self.dialect.numbers.max_mm;
        if value_mm.is_nan() || value_mm.abs() > max_mm {
            let axis = ['X', 'Y', 'Z'][axis];
            return Err(match value_mm.is_finite() {
                true => GcodeError::Large { axis, value_mm, number: self.count, max_mm },
                false => GcodeError::NotFinite { axis, value_mm, number: self.count },
            });
        }
        Ok((value_mm * self.per_mm).round() as i64)
    }

    fn push_turn(&mut self, letter: char, turned: i64) {
        let numbers = &self.dialect.numbers;
        self.text.push(letter as u8);
        if numbers.plus && turned >= 0 {
            self.text.push(b'+');
        }
        push_decimals(&mut self.text, turned, numbers.angle_decimals);
    }

    /// Returns the angle that the scale of the rotary axis shows for the tilt `tilt_rad` of the wheel. The result is in
    /// degrees, as a whole number of units of the last written digit: 1.25° gives 125 if the dialect has two decimals
    /// for angles.
    ///
    /// # Errors
    /// A tilt that is not finite; a program without a rotary axis.
    fn rounded_turn(&self, tilt_rad: f64) -> Result<i64, GcodeError> {
        let Some(rotary) = self.rotary.filter(|_| tilt_rad.is_finite()) else {
            return Err(GcodeError::NotFinite { axis: 'A', value_mm: tilt_rad, number: self.count });
        };
        Ok((rotary.scale_reading_rad(tilt_rad).to_degrees() * self.per_deg).round() as i64)
    }

    /// Converts a feed to a whole number of units of the last written digit: 600.5 mm/min gives 6005 if the dialect has
    /// one decimal for feeds.
    ///
    /// # Errors
    /// A feed that rounds to 0.
    fn rounded_feed(&self, feed_mm_min: f64) -> Result<i64, GcodeError> {
        match (feed_mm_min * self.feed_per).round() as i64 {
            0 => {
                Err(GcodeError::Slow { feed_mm_min, decimals: self.dialect.numbers.feed_decimals, number: self.count })
            }
            feed => Ok(feed),
        }
    }
}

/// Appends a feed to `text`, without zeros at the end of its decimals. `feed` is in units of the last written digit:
/// 6005 is written as `600.5` if the dialect has one decimal for feeds.
fn push_feed(text: &mut Vec<u8>, feed: i64, dialect: &Dialect) {
    let before = text.len();
    push_decimals(text, feed, dialect.numbers.feed_decimals);
    if text[before..].contains(&b'.') {
        while text.last() == Some(&b'0') {
            text.pop();
        }
    }
    match (text.last(), dialect.numbers.feed_point) {
        (Some(b'.'), false) => drop(text.pop()),
        (Some(b'.'), true) => {}
        (_, true) if !text[before..].contains(&b'.') => text.push(b'.'),
        _ => {}
    }
}

/// Appends the number of a block to `text` if the dialect numbers blocks. `numbered` is the number of earlier blocks
/// with a number. After the last number of the dialect, the numbers begin again with the first one.
#[inline]
pub(super) fn number(text: &mut Vec<u8>, dialect: &Dialect, numbered: u64) {
    let Some(blocks) = &dialect.blocks else { return };
    // After the last number the first one follows again.
    let round = u64::from(blocks.last.saturating_sub(blocks.first) / blocks.step.max(1)) + 1;
    let number = u64::from(blocks.first) + u64::from(blocks.step) * (numbered % round);
    text.extend_from_slice(format!("{}{number} ", blocks.letter).as_bytes());
}

#[inline]
pub(super) fn end_line(text: &mut Vec<u8>, dialect: &Dialect) {
    text.extend_from_slice(match dialect.text.line_end {
        LineEnd::Lf => b"\n",
        LineEnd::Crlf => b"\r\n",
    });
}

/// Lines before and after the moves.
struct Frame<'a> {
    dialect: &'a Dialect,
    begin: Vec<String>,
    setup: Vec<String>,
    end: Vec<String>,
}

impl<'a> Frame<'a> {
    fn new(post: &Post<'a>, header: &ProgramHeader) -> Result<Self, GcodeError> {
        let dialect = post.dialect;
        let name = dialect.name(&header.part, header.cycle);
        let number = dialect.number(header.cycle)?.map_or(String::new(), |number| number.to_string());
        let of = |line: &String| line.replace(NAME, &name).replace(NUMBER, &number);
        let [mode, mode_ends] = &post.mode;
        let of_arcs = post.arcs.iter().map(|(words, _)| *words);
        let turning = header.rotary.as_ref().map(|rotary| dialect.turning(rotary)).transpose()?;
        let [turn, turn_ends] = turning.map_or([&[][..]; 2], |turning| [&turning.begin[..], &turning.end[..]]);
        let arcs_begin = of_arcs.clone().flat_map(|arcs| &arcs.begin);
        let arcs_end = of_arcs.flat_map(|arcs| &arcs.end);
        Ok(Self {
            dialect,
            begin: dialect.program.begin.iter().map(of).collect(),
            setup: dialect.program.setup.iter().chain(arcs_begin).chain(mode).chain(turn).cloned().collect(),
            end: turn_ends
                .iter()
                .chain(mode_ends)
                .chain(arcs_end)
                .cloned()
                .chain(dialect.program.end.iter().map(of))
                .collect(),
        })
    }

    /// Appends `line` and a line end to `text`. If `has_number` is true, a block number is written before `line`, and
    /// the counter `numbered` of such blocks increases by 1. A line that is only a percent sign never has a number.
    fn line(&self, text: &mut Vec<u8>, line: &str, has_number: bool, numbered: &mut u64) {
        // A percent sign is not a block and has no number.
        if has_number && line != "%" {
            number(text, self.dialect, *numbered);
            *numbered += 1;
        }
        text.extend_from_slice(line.as_bytes());
        end_line(text, self.dialect);
    }

    /// Returns the lines of the program before the moves, and the number of blocks with a number among these lines. The
    /// comments in these lines state the number of lines of the whole program. `arcs` is `None` if the program has no
    /// arcs.
    fn head(&self, header: &ProgramHeader, summary: &PathSummary, arcs: Option<&ArcSummary>) -> (String, u64) {
        let lines = |count: u64| {
            let (mut text, mut numbered) = (Vec::new(), 0);
            let all = self.dialect.blocks.as_ref().is_some_and(|blocks| blocks.all);
            self.begin.iter().for_each(|line| self.line(&mut text, line, all, &mut numbered));
            for words in header_words(header, summary, arcs, count) {
                for line in comments(self.dialect, &words) {
                    self.line(&mut text, &line, all, &mut numbered);
                }
            }
            self.setup.iter().for_each(|line| self.line(&mut text, line, true, &mut numbered));
            (String::from_utf8_lossy(&text).into_owned(), numbered)
        };
        let blocks_of_arc = match self.dialect.arcs.as_ref().map(|arcs| arcs.centre) {
            Some(CentreWords::BlockBefore) => 2,
            _ => 1,
        };
        let moves = arcs.map_or(summary.moves, |arcs| arcs.moves + (blocks_of_arc - 1) * arcs.arcs);
        let count = lines(0).0.lines().count() as u64 + moves + self.end.len() as u64;
        lines(count)
    }

    /// Returns the lines of the program after the moves. `numbered` is the number of numbered blocks before them.
    fn tail(&self, mut numbered: u64) -> String {
        let mut text = Vec::new();
        self.end.iter().for_each(|line| self.line(&mut text, line, true, &mut numbered));
        String::from_utf8_lossy(&text).into_owned()
    }
}

/// Formats `words` as comments of the dialect: as many lines as the longest line of the dialect requires.
pub(super) fn comments(dialect: &Dialect, words: &str) -> Vec<String> {
    let text = &dialect.text;
    // A block number before the comment takes space too.
    let marks = text.comment_begins.len() + text.comment_ends.len() + 12;
    let room = text.max_line_length.saturating_sub(marks).max(20);
    let words = comment(words);
    let words = if text.upper_case { words.to_ascii_uppercase() } else { words };
    let mut lines = vec![String::new()];
    for word in words.split(' ') {
        let last = lines.len() - 1;
        let line = &mut lines[last];
        if line.is_empty() || line.len() + 1 + word.len() <= room {
            line.push_str(if line.is_empty() { "" } else { " " });
            line.push_str(word);
        } else {
            lines.push(word.to_owned());
        }
    }
    lines.iter().map(|line| format!("{}{line}{}", text.comment_begins, text.comment_ends)).collect()
}

/// Returns the texts of the comments at the beginning of a program, one text per comment. `h` is the content of the
/// header, and `s` the summary of the path. `arcs` is the summary of the arcs; `None` if the program has none. `lines`
/// is the number of lines of the whole program.
fn header_words(h: &ProgramHeader, s: &PathSummary, arcs: Option<&ArcSummary>, lines: u64) -> Vec<String> {
    let mut said = Vec::new();
    let mut say = |words: std::fmt::Arguments| said.push(words.to_string());
    if h.simulation {
        say(format_args!("SIMULATION"));
    }
    say(format_args!("Regrind {} tool path", env!("CARGO_PKG_VERSION")));
    say(format_args!("part: {}", h.part));
    say(format_args!("part: sha256 {}", HEXLOWER.encode(&h.base_identity)));
    say(format_args!("cycle: {}", h.cycle));
    say(format_args!("base: sha256 {}", HEXLOWER.encode(&h.base_identity)));
    say(format_args!("map: sha256 {}", HEXLOWER.encode(&h.map_identity)));
    if h.uncorrected {
        say(format_args!("{UNCORRECTED}"));
    }
    let side = if h.from_below { "z into the part, the wheel comes from -z" } else { "z away from the part" };
    say(format_args!("frame: model, {side}; G54 has its zero in the origin of the model"));
    say(format_args!("units: mm, mm/min; a correction is positive where it leaves material, along the outward normal"));
    say(format_args!("level over the nominal surface: {} mm", short(h.level_mm)));
    say(format_args!("wheel: {}", h.wheel));
    if let Some(rotary) = &h.rotary {
        let [tilt, places] = tilt_in_words(rotary, h, s);
        say(format_args!("tilt: {tilt}"));
        say(format_args!("places: {places}"));
    }
    for taken in &h.parameters {
        say(format_args!("parameter: {taken}"));
    }
    say(format_args!("tracks: {}", h.tracks));
    say(format_args!("feed: {} mm/min", short(s.feed_mm_min)));
    say(format_args!("spark-out: the program is run {} times more", h.spark_out_passes));
    for (k, axis) in ['X', 'Y', 'Z'].into_iter().enumerate() {
        say(format_args!("limits: {axis} {} to {} mm", short(s.min_mm[k]), short(s.max_mm[k])));
    }
    say(format_args!("length: {} mm at feed, {:.1} minutes", short(s.length_mm.round()), s.duration_s / 60.0));
    say(format_args!("points: {}", s.points));
    if let Some(of) = arcs {
        let (arcs, left, off_um) = (of.arcs, of.lines, 1e3 * of.deviation_mm);
        say(format_args!("arcs: {arcs} and {left} lines stand for the points, within {off_um:.4} um of the path"));
    }
    say(format_args!("lines: {lines}"));
    say(format_args!("spindle and coolant are the machine's own; start them before"));
    said
}

/// Returns two texts for the comments in the header of a program. The first text describes the tilt of the wheel and
/// the range of the rotary axis. The second text states which point X, Y and Z describe: the wheel's centre, or the
/// position of the slides.
fn tilt_in_words(rotary: &RotaryAxis, h: &ProgramHeader, s: &PathSummary) -> [String; 2] {
    let about = if rotary.axis == RotationAxis::X { "x" } else { "y" };
    let sense = if rotary.reversed { "left-handed" } else { "right-handed" };
    let reached = s.head_rotation.map_or(String::new(), |turned| {
        let [a, b] =
            [turned.min_tilt_rad, turned.max_tilt_rad].map(|peak| rotary.scale_reading_rad(peak.value).to_degrees());
        format!(", {:.4} to {:.4} degrees", a.min(b), a.max(b))
    });
    let of = match rotary.pivot_mm {
        None => "XYZ is the wheel's centre, which the control keeps".to_owned(),
        Some(v) => format!(
            "the slides', XYZ is the wheel's centre with the head upright; the pivot is {} {} {} mm from it, feeds are inverse times",
            short(v.x),
            short(v.y),
            short(v.z)
        ),
    };
    [format!("{}, {} turns about {about} {sense}{reached}", h.lean, rotary.letter), of]
}

/// Returns the first 200 characters of `words` as they are allowed in a comment: round brackets, which would begin or
/// end a comment, become square brackets, and characters other than printable ASCII become `?`.
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
    use crate::gcode::dialect::{Blocks, tests::shipped};
    use regrind_core::compensation::path::{PathMode, Peak};
    use regrind_core::geometry::Point;

    /// Tracks along x, forward and back, one after the other.
    fn tracks(count: usize) -> Vec<std::vec::IntoIter<Move>> {
        let feed = |x: f64, y: f64| Move::Feed { to: Point::new(x, y, 0.1 * y), feed_mm_min: 600.0 };
        let track = |k: usize| {
            let (y, turn) = (k as f64, if k.is_multiple_of(2) { 1.0 } else { -1.0 });
            let (over, up) = (Move::RapidXy([-turn, y]), Move::RapidZ(5.0));
            vec![over, Move::RapidZ(1.0), feed(-turn, y), feed(turn, y), up].into_iter()
        };
        (0..count).map(track).collect()
    }

    fn write(tracks: &[std::vec::IntoIter<Move>], points: u64) -> Result<String, GcodeError> {
        let text = write_in(&shipped("linuxcnc"), tracks, points)?;
        Ok(text[text.find("G54").unwrap()..].to_owned())
    }

    fn write_in(dialect: &Dialect, tracks: &[std::vec::IntoIter<Move>], points: u64) -> Result<String, GcodeError> {
        write_with(dialect, tracks, points, None)
    }

    fn write_with<B: Into<ProgramBlock> + Clone + Send + Sync>(
        dialect: &Dialect,
        tracks: &[std::vec::IntoIter<B>],
        points: u64,
        arcs: Option<&ArcSummary>,
    ) -> Result<String, GcodeError> {
        let header = ProgramHeader {
            part: "part".into(),
            cycle: 1,
            base_identity: [1; 32],
            map_identity: [2; 32],
            uncorrected: false,
            level_mm: 0.0,
            from_below: false,
            rotary: None,
            lean: String::new(),
            wheel: "ball".into(),
            parameters: Vec::new(),
            tracks: "raster".into(),
            spark_out_passes: 0,
            simulation: true,
            exactness: Exactness {
                mode: PathMode::Blend,
                tolerance_mm: 1e-4,
                controller_mm: Some(1e-4),
                chord_error_mm: 1e-4,
                arcs_within_mm: arcs.map(|_| 1e-4),
            },
        };
        let summary = PathSummary {
            moves: 5 * tracks.len() as u64,
            points,
            min_mm: [0.0; 3],
            max_mm: [0.0; 3],
            length_mm: 0.0,
            rapid_mm: 0.0,
            duration_s: 0.0,
            speed_mm_s: [Peak::default(); 3],
            acceleration_mm_s2: Peak::default(),
            jerk_mm_s3: Peak::default(),
            feed_mm_min: 600.0,
            run_up_mm: 0.0,
            head_rotation: None,
        };
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("part.ngc");
        write_tracks(&file, &header, &dialect.post(&header.exactness)?, (&summary, arcs), tracks)?;
        Ok(std::fs::read_to_string(file).unwrap())
    }

    #[test]
    fn track_start_repeats_modal_words() {
        let text = write(&tracks(2), 4).unwrap();
        let lines: Vec<&str> = text.lines().skip_while(|line| !line.starts_with("G0")).collect();
        let first = ["G0 X-1.000000Y0.000000", "Z1.000000", "G1 Z0.000000F600", "X1.000000", "G0 Z5.000000"];
        let second = ["G0 X1.000000Y1.000000", "Z1.000000", "G1 Z0.100000F600", "X-1.000000", "G0 Z5.000000"];
        assert_eq!(lines, [&first[..], &second, &["M2"]].concat());
    }

    /// The blocks of a program without comments.
    fn blocks(name: &str) -> Vec<String> {
        let dialect = shipped(name);
        let text = write_in(&dialect, &tracks(1), 2).unwrap();
        let ends = if dialect.text.line_end == LineEnd::Crlf { "\r\n" } else { "\n" };
        assert!(text.ends_with(ends) && text.matches('\n').count() == text.matches(ends).count());
        let is_comment = |line: &&str| line.contains(&dialect.text.comment_begins) && !line.starts_with('O');
        text.lines().filter(|line| !is_comment(line)).map(str::to_owned).collect()
    }

    #[test]
    fn dialects_write_expected_lines() {
        let fanuc = [
            "%",
            "O7001 (PART_C1)",
            "G21 G90 G94 G17",
            "G40 G49 G80 G54",
            "G05.1 Q1",
            "G00 X-1.0000 Y0.0000",
            "Z1.0000",
            "G01 Z0.0000 F600.",
            "X1.0000",
            "G00 Z5.0000",
            "G05.1 Q0",
            "M30",
            "%",
        ];
        assert_eq!(blocks("fanuc"), fanuc);
        let sinumerik = [
            "N10 G710 G90 G94 G17 G40 G54",
            "N20 G642 CTOL=0.0001",
            "N30 FFWON SOFT",
            "N40 G0 X-1.000000 Y0.000000",
            "N50 Z1.000000",
            "N60 G1 Z0.000000 F600",
            "N70 X1.000000",
            "N80 G0 Z5.000000",
            "N90 FFWOF BRISK",
            "N100 M30",
        ];
        assert_eq!(blocks("sinumerik"), sinumerik);
        let heidenhain = [
            "0 BEGIN PGM PART_C1 MM",
            "CYCL DEF 32.0 TOLERANCE",
            "CYCL DEF 32.1 T0.0001",
            "L X-1.0000 Y+0.0000 R0 FMAX",
            "L Z+1.0000 R0 FMAX",
            "L Z+0.0000 F600",
            "L X+1.0000",
            "L Z+5.0000 R0 FMAX",
            "CYCL DEF 32.0 TOLERANCE",
            "CYCL DEF 32.1",
            "M30",
            "END PGM PART_C1 MM",
        ];
        let found = blocks("heidenhain");
        assert_eq!(found[0], heidenhain[0]);
        let first: usize = found[1].split_once(' ').unwrap().0.parse().unwrap();
        let expected = heidenhain[1..].iter().enumerate().map(|(k, words)| format!("{} {words}", first + k));
        assert_eq!(found[1..], expected.collect::<Vec<_>>());
    }

    /// A track with a quarter turn about the origin in the plane of z and x, with or without motion along y, a line,
    /// and the same turn backwards.
    fn turning(y_mm: f64) -> Vec<std::vec::IntoIter<ProgramBlock>> {
        let arc = |clockwise: bool, to: Point| {
            let (plane, centre_mm) = (Plane::ZX, [0.0, 0.0]);
            ProgramBlock::Arc(Arc { plane, clockwise, to, centre_mm, feed_mm_min: 600.0, deviation_mm: 0.0 })
        };
        let feed = |x: f64, y: f64, z: f64| Move::Feed { to: Point::new(x, y, z), feed_mm_min: 600.0 };
        let straight = [Move::RapidXy([0.0, 0.0]), Move::RapidZ(3.0), feed(0.0, 0.0, 2.0)].map(ProgramBlock::Straight);
        let (there, back) = (arc(false, Point::new(2.0, y_mm, 0.0)), arc(true, Point::new(0.0, y_mm, 2.0)));
        let over = [feed(3.0, y_mm, 0.0), feed(2.0, y_mm, 0.0)].map(ProgramBlock::Straight);
        let blocks =
            straight.into_iter().chain([there]).chain(over).chain([back, ProgramBlock::Straight(Move::RapidZ(5.0))]);
        vec![blocks.collect::<Vec<_>>().into_iter()]
    }

    fn turned(name: &str, y_mm: f64) -> Vec<String> {
        let dialect = shipped(name);
        let summary = ArcSummary { moves: 8, arcs: 2, lines: 3, ..ArcSummary::default() };
        let text = write_with(&dialect, &turning(y_mm), 0, Some(&summary)).unwrap();
        let counted = format!("LINES: {}", text.lines().count());
        assert!(text.to_ascii_uppercase().contains(&counted), "{name}: {text}");
        let is_comment = |line: &&str| line.contains(&dialect.text.comment_begins) && !line.starts_with('O');
        text.lines().filter(|line| !is_comment(line)).map(str::to_owned).collect()
    }

    #[test]
    fn dialects_write_expected_arcs() {
        let linuxcnc = [
            "G21 G90 G94 G17 G40 G49 G80 G54",
            "G91.1",
            "G64 P0.0001 Q0",
            "G0 X0.000000Y0.000000",
            "Z3.000000",
            "G1 Z2.000000F600",
            "G18 G3 X2.000000Y0.100000Z0.000000I0.000000K-2.000000",
            "G1 X3.000000",
            "X2.000000",
            "G2 X0.000000Z2.000000I-2.000000K0.000000",
            "G0 Z5.000000",
            "G17",
            "M2",
        ];
        assert_eq!(turned("linuxcnc", 0.1), linuxcnc);
        let fanuc = turned("fanuc", 0.1);
        assert_eq!(fanuc[8..10], ["G18 G03 X2.0000 Y0.1000 Z0.0000 I0.0000 K-2.0000", "G01 X3.0000"]);
        assert_eq!(fanuc[fanuc.len() - 4..], ["G05.1 Q0", "G17", "M30", "%"]);
        let sinumerik = turned("sinumerik", 0.0);
        assert_eq!(sinumerik[6..8], ["N70 G18 G3 X2.000000 Z0.000000 I0.000000 K-2.000000", "N80 G1 X3.000000"]);
        let heidenhain = turned("heidenhain", 0.0);
        let words: Vec<&str> = heidenhain[6..13].iter().map(|line| line.split_once(' ').unwrap().1).collect();
        let expected = [
            "CC X+0.0000 Z+0.0000",
            "C X+2.0000 Z+0.0000 DR+",
            "L X+3.0000",
            "L X+2.0000",
            "CC X+0.0000 Z+0.0000",
            "C X+0.0000 Z+2.0000 DR-",
            "L Z+5.0000 R0 FMAX",
        ];
        assert_eq!(words, expected);
        // Absolute centres instead of centres relative to the start.
        let mut places = shipped("linuxcnc");
        places.arcs.as_mut().unwrap().centre = CentreWords::Absolute;
        let text = write_with(&places, &turning(0.0), 0, Some(&ArcSummary { moves: 8, ..ArcSummary::default() }));
        assert!(text.unwrap().contains("G2 X0.000000Z2.000000I0.000000K0.000000"));
    }

    #[test]
    fn line_length_and_header_count() {
        for name in ["linuxcnc", "fanuc", "sinumerik", "heidenhain"] {
            let dialect = shipped(name);
            let text = write_in(&dialect, &tracks(3), 6).unwrap();
            assert!(text.is_ascii() && text.lines().all(|line| line.len() <= dialect.text.max_line_length), "{name}");
            let counted = format!("LINES: {}", text.lines().count());
            assert!(text.to_ascii_uppercase().contains(&counted), "{name}: {text}");
            assert!(!dialect.text.upper_case || text == text.to_ascii_uppercase(), "{name}");
        }
    }

    #[test]
    fn redundant_move_and_block_number_wrap() {
        let feed = |x: f64| Move::Feed { to: Point::new(x, 0.0, 0.0), feed_mm_min: 600.0 };
        let still = vec![vec![Move::RapidZ(5.0), Move::RapidXy([0.0; 2]), feed(1.0), feed(1.0), feed(2.0)].into_iter()];
        let mut dialect = shipped("sinumerik");
        dialect.blocks = Some(Blocks { last: 50, ..dialect.blocks.clone().unwrap() });
        let text = write_in(&dialect, &still, 3).unwrap();
        let lines: Vec<&str> = text.lines().filter(|line| line.starts_with('N')).collect();
        assert_eq!(lines[4..6], ["N50 X0.000000 Y0.000000", "N10 G1 X1.000000 Z0.000000 F600"]);
        assert_eq!(lines[6..8], ["N20 X1.000000 Y0.000000 Z0.000000", "N30 X2.000000"]);
    }

    #[test]
    fn write_refuses_values_out_of_range() {
        let one = |at: Point, feed_mm_min: f64| {
            let moves = [Move::RapidZ(5.0), Move::RapidXy([0.0; 2]), Move::RapidZ(1.0)];
            vec![
                moves
                    .into_iter()
                    .chain([Move::Feed { to: at, feed_mm_min }, Move::RapidZ(5.0)])
                    .collect::<Vec<_>>()
                    .into_iter(),
            ]
        };
        let fanuc = shipped("fanuc");
        let written = |at, feed| write_in(&fanuc, &one(at, feed), 1);
        assert!(written(Point::new(9999.9, 0.0, 0.0), 0.4).is_ok());
        assert!(matches!(
            written(Point::new(10_000.1, 0.0, 0.0), 1.0),
            Err(GcodeError::Large { axis: 'X', number: 4, .. })
        ));
        assert!(matches!(written(Point::origin(), 0.0004), Err(GcodeError::Slow { number: 4, .. })));
    }

    #[test]
    fn parallel_write_matches_serial() {
        let many = tracks(1000);
        let after_header = |text: String| text[text.find("G0").unwrap()..].to_owned();
        let [at_once, one_by_one] = [2000, u64::MAX].map(|points| after_header(write(&many, points).unwrap()));
        assert!(at_once == one_by_one && at_once.lines().count() == 5001);
        // A few at a time, with a remainder.
        let some = after_header(write(&many, AT_ONCE * 1000 / 7).unwrap());
        assert!(some == at_once);
    }

    #[test]
    fn write_error_names_move_number() {
        let mut many = tracks(1000);
        let broken = Move::Feed { to: Point::new(0.0, f64::NAN, 0.0), feed_mm_min: 600.0 };
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

//! Random programs, drawn move by move with the truth of each move. `regrind compensate` either adds exactly the map,
//! or refuses the program.
//!
//! The truth of a program comes from the draw, in absolute millimetres. Its text expresses the same by modes, units,
//! planes and centres. The draw also determines which programs contain something that must be refused.

use std::fmt::Write as _;
use std::fs;

use crate::compensate::Shop;
use crate::path::error_mm;
use rand::RngExt;
use regrind_sim::Rng;
use regrind_testutils::sample::seeds;

/// Tolerance, in mm: the requested one, a tenth of it, and the rounding to six decimals.
const TOLERANCE_MM: f64 = 1.1e-5;
const DIGIT_MM: f64 = 2e-6;

/// Path at feed: straight, or about a centre in the plane of two axes.
#[derive(Clone, Copy, Debug)]
pub struct Way {
    pub from: [f64; 3],
    pub to: [f64; 3],
    /// The axes of the plane and the third one, the centre, and the angle.
    pub about: Option<([usize; 3], [f64; 2], f64)>,
}

impl Way {
    pub fn at(&self, share: f64) -> [f64; 3] {
        let mut at: [f64; 3] = std::array::from_fn(|k| self.from[k] + share * (self.to[k] - self.from[k]));
        if let Some(([a, b, _], centre, angle)) = self.about {
            let arm = |at: [f64; 3]| [at[a] - centre[0], at[b] - centre[1]];
            let ([p, q], [s, t]) = (arm(self.from), arm(self.to));
            let radius = p.hypot(q) + share * (s.hypot(t) - p.hypot(q));
            let (sine, cosine) = (q.atan2(p) + share * angle).sin_cos();
            (at[a], at[b]) = (centre[0] + radius * cosine, centre[1] + radius * sine);
        }
        at
    }

    /// Returns the distance of a place from the path.
    fn off(&self, place: [f64; 3]) -> f64 {
        let along: [f64; 3] = std::array::from_fn(|k| self.to[k] - self.from[k]);
        let arm: [f64; 3] = std::array::from_fn(|k| place[k] - self.from[k]);
        let dot = |a: [f64; 3], b: [f64; 3]| (0..3).map(|k| a[k] * b[k]).sum::<f64>();
        let share = match self.about {
            None => dot(arm, along) / dot(along, along).max(1e-30),
            Some(([a, b, _], centre, angle)) => {
                let turned = |at: [f64; 3]| (at[b] - centre[1]).atan2(at[a] - centre[0]);
                let turn = (turned(place) - turned(self.from)).rem_euclid(std::f64::consts::TAU);
                // The end of a full turn is its beginning too.
                let forth = if angle > 0.0 { turn } else { (std::f64::consts::TAU - turn) % std::f64::consts::TAU };
                let near = |share: f64| distance(self.at(share.clamp(0.0, 1.0)), place);
                let share = forth / angle.abs();
                return near(share).min(near(0.0)).min(near(1.0));
            }
        };
        distance(self.at(share.clamp(0.0, 1.0)), place)
    }
}

fn distance(a: [f64; 3], b: [f64; 3]) -> f64 {
    (0..3).map(|k| (a[k] - b[k]).powi(2)).sum::<f64>().sqrt()
}

/// Move of a program.
#[derive(Clone, Debug)]
pub enum Move {
    /// Rapid move to these axes.
    Rapid([Option<f64>; 3]),
    /// Move in machine coordinates, or to the reference point.
    Elsewhere,
    Feed(Way),
}

/// Random program.
pub struct RandomProgram {
    pub text: String,
    pub moves: Vec<Move>,
    /// Description of the line that must be refused, if there is one.
    pub refused: Option<&'static str>,
}

struct Draw {
    rng: Rng,
    text: String,
    moves: Vec<Move>,
    at: [f64; 3],
    inch: bool,
    relative: bool,
    absolute_centres: bool,
    plane: usize,
    motion: Option<u8>,
    decimals: usize,
}

const PLANES: [[usize; 3]; 3] = [[0, 1, 2], [2, 0, 1], [1, 2, 0]];

impl Draw {
    fn chance(&mut self, of: f64) -> bool {
        self.rng.random::<f64>() < of
    }

    fn between(&mut self, from: f64, to: f64) -> f64 {
        from + (to - from) * self.rng.random::<f64>()
    }

    fn unit(&self) -> f64 {
        if self.inch { 25.4 } else { 1.0 }
    }

    /// Returns a number as written, and its value in millimetres.
    fn written(&self, value_mm: f64) -> (String, f64) {
        let text = format!("{:.*}", self.decimals, value_mm / self.unit());
        let value: f64 = text.parse().unwrap();
        (text, value * self.unit())
    }

    /// Returns the axis words for a target, and the point that they lead to.
    fn axes(&mut self, to: [Option<f64>; 3]) -> (String, [f64; 3]) {
        let (mut text, mut target) = (String::new(), self.at);
        for k in 0..3 {
            let Some(to) = to[k] else { continue };
            let (word, value) = self.written(if self.relative { to - self.at[k] } else { to });
            let _ = write!(text, " {}{word}", ['X', 'Y', 'Z'][k]);
            target[k] = if self.relative { self.at[k] + value } else { value };
        }
        (text, target)
    }

    /// Returns the word of a motion, which can be omitted while it is modal.
    fn word(&mut self, motion: u8) -> String {
        let in_force = self.motion == Some(motion) && self.chance(0.6);
        self.motion = Some(motion);
        if in_force { String::new() } else { ["G0", "G1", "G2", "G3"][usize::from(motion)].to_owned() }
    }

    fn line(&mut self, line: &str) {
        if self.chance(0.1) {
            let _ = write!(self.text, "N{} ", 10 * self.moves.len());
        }
        self.text += line.trim();
        let end = if self.chance(0.1) { " (a remark)\n" } else { "\n" };
        self.text += end;
    }

    fn rapid(&mut self, to: [Option<f64>; 3]) {
        let word = self.word(0);
        let (axes, target) = self.axes(to);
        self.line(&format!("{word}{axes}"));
        self.at = target;
        self.moves.push(Move::Rapid(std::array::from_fn(|k| to[k].map(|_| target[k]))));
    }

    fn place(&mut self) -> [f64; 3] {
        [self.between(-18.0, 18.0), self.between(-9.0, 9.0), self.between(-0.5, 3.0)]
    }

    fn straight(&mut self) {
        let place = self.place();
        let mut to = place.map(Some);
        let without = (self.rng.random::<f64>() * 4.0) as usize;
        if without < 3 {
            to[without] = None;
        }
        let word = self.word(1);
        let feed = if self.chance(0.3) { " F350" } else { "" };
        let (axes, target) = self.axes(to);
        self.line(&format!("{word}{axes}{feed}"));
        self.moves.push(Move::Feed(Way { from: self.at, to: target, about: None }));
        self.at = target;
    }

    fn arc(&mut self) {
        let plane = (self.rng.random::<f64>() * 3.0) as usize;
        let axes = PLANES[plane];
        let [a, b, c] = axes;
        let chosen = if plane == self.plane && self.chance(0.7) { String::new() } else { format!("G{} ", 17 + plane) };
        self.plane = plane;
        let (radius, begins) = (self.between(1.0, 5.0), self.between(-3.0, 3.0));
        let left = self.chance(0.5);
        let whole = self.chance(0.15);
        let by_radius = !whole && self.chance(0.3);
        let sweep = if whole { 6.0 } else { self.between(0.3, 5.5) } * if left { 1.0 } else { -1.0 };
        let centre = [self.at[a] - radius * begins.cos(), self.at[b] - radius * begins.sin()];
        let word = self.word(if left { 3 } else { 2 });
        let mut to = [None; 3];
        if !whole {
            let end = begins + sweep;
            (to[a], to[b]) = (Some(centre[0] + radius * end.cos()), Some(centre[1] + radius * end.sin()));
            if self.chance(0.3) {
                to[c] = Some(self.at[c] + self.between(-1.0, 1.0));
            }
        }
        let (words, target) = self.axes(to);
        let (mut text, mut given) = (format!("{chosen}{word}{words}"), centre);
        if by_radius {
            let (word, radius) = self.written(if sweep.abs() > std::f64::consts::PI { -radius } else { radius });
            let _ = write!(text, " R{word}");
            let half: [f64; 2] = [0.5 * (target[a] - self.at[a]), 0.5 * (target[b] - self.at[b])];
            let chord = half[0].hypot(half[1]);
            let height = (radius * radius - chord * chord).max(0.0).sqrt();
            // The centre is to the left of the chord for the short arc to the left.
            let side = if left == (radius > 0.0) { height / chord } else { -height / chord };
            given = [self.at[a] + half[0] - side * half[1], self.at[b] + half[1] + side * half[0]];
        } else {
            for (n, k) in [a, b].into_iter().enumerate() {
                let from = if self.absolute_centres { 0.0 } else { self.at[k] };
                let (word, value) = self.written(centre[n] - from);
                let _ = write!(text, " {}{word}", ['I', 'J', 'K'][k]);
                given[n] = from + value;
            }
        }
        self.line(&text);
        let arm = |at: [f64; 3]| (at[b] - given[1]).atan2(at[a] - given[0]);
        let turn = (arm(target) - arm(self.at)).rem_euclid(std::f64::consts::TAU);
        let turn = if turn < 1e-9 { std::f64::consts::TAU } else { turn };
        let angle = if left {
            turn
        } else if whole {
            -std::f64::consts::TAU
        } else {
            turn - std::f64::consts::TAU
        };
        self.moves.push(Move::Feed(Way { from: self.at, to: target, about: Some((axes, given, angle)) }));
        self.at = target;
    }

    /// Approaches again, in absolute coordinates.
    fn approach(&mut self) {
        if std::mem::replace(&mut self.relative, false) {
            self.line("G90");
        }
        let [x, y, z] = self.place();
        self.rapid([Some(x), Some(y), None]);
        self.rapid([None, None, Some(z)]);
    }

    fn change(&mut self) {
        match (self.rng.random::<f64>() * 10.0) as usize {
            0 => {
                self.inch = !self.inch;
                self.decimals = if self.inch { 5 } else { 4 };
                self.line(if self.inch { "G20" } else { "G21" });
            }
            1 => {
                self.relative = !self.relative;
                self.line(if self.relative { "G91" } else { "G90" });
            }
            2 => {
                self.absolute_centres = !self.absolute_centres;
                self.line(if self.absolute_centres { "G90.1" } else { "G91.1" });
            }
            3 => {
                let word = if self.chance(0.5) { "G43 H1" } else { "G49" };
                self.line(word);
                self.approach();
            }
            4 => {
                if std::mem::replace(&mut self.relative, false) {
                    self.line("G90");
                }
                self.motion = Some(0);
                self.line("G53 G0 Z0");
                self.moves.push(Move::Elsewhere);
                self.approach();
            }
            5 => {
                self.relative = true;
                self.line("G91 G28 Z0");
                self.moves.push(Move::Elsewhere);
                self.approach();
            }
            6 => self.line("G4 P0.1"),
            7 => self.line("S3000 M3 M8"),
            8 => {
                self.line("G80");
                self.motion = None;
            }
            _ => self.approach(),
        }
    }

    /// Writes a line that controls interpret differently than intended, or that hides the tool's destination.
    fn slip(&mut self) -> &'static str {
        let slips = [
            ("G1 X1 Y1 I2", "no meaning"),
            ("G1 X1 R4", "no meaning"),
            ("G4 X2.", "no meaning"),
            ("G0 G1 X2", "only one"),
            ("G1 X3 P2", "no meaning"),
            ("G43 H1\nG1 X2 F100", "position of Z is unknown"),
            ("G49\nG1 X2 F100", "position of Z is unknown"),
            ("M6 T2\nG1 X2 F100", "unknown"),
            ("G92 X0", "zero"),
            ("G1 X1 A7", "turns"),
            ("G2 X9", "centre"),
            ("G1 F100 Q3 X2", "no meaning"),
        ];
        let (lines, words) = slips[(self.rng.random::<f64>() * slips.len() as f64) as usize];
        self.text += lines;
        self.text += "\n";
        words
    }
}

/// Draws a program.
pub fn drawn(seed: u64) -> RandomProgram {
    let rng = regrind_sim::rng(seed);
    let mut draw = Draw {
        rng,
        text: String::new(),
        moves: Vec::new(),
        at: [f64::NAN; 3],
        inch: false,
        relative: false,
        absolute_centres: false,
        plane: 0,
        motion: None,
        decimals: 3,
    };
    draw.inch = draw.chance(0.3);
    draw.decimals = if draw.inch { 4 + usize::from(draw.chance(0.5)) } else { 3 + usize::from(draw.chance(0.5)) };
    let first = if draw.inch { "G20 G90 G17 G91.1" } else { "G21 G90 G17 G91.1" };
    draw.line(first);
    draw.rapid([None, None, Some(10.0)]);
    draw.approach();
    draw.text += "F400\n";
    let mut refused = None;
    let count = 6 + (draw.rng.random::<f64>() * 12.0) as usize;
    for k in 0..count {
        match draw.rng.random::<f64>() {
            share if share < 0.35 => draw.straight(),
            // The map ends at 30 and 20 mm, and an arc reaches 10 mm.
            share if share < 0.75 && draw.at[0].abs() < 19.0 && draw.at[1].abs() < 10.0 => draw.arc(),
            _ => draw.change(),
        }
        if k == count / 2 && draw.chance(0.15) {
            refused = Some(draw.slip());
            break;
        }
    }
    draw.straight();
    draw.text += "M2\n";
    RandomProgram { text: draw.text, moves: draw.moves, refused }
}

/// Reads a corrected program: absolute, with a motion word in every move.
pub fn read(text: &str) -> Vec<Move> {
    let (mut moves, mut at, mut unit, mut plane, mut absolute) = (Vec::new(), [f64::NAN; 3], 1.0, 0, false);
    for line in text.lines().map(|line| line.split(['(', ';']).next().unwrap()) {
        let words: Vec<(char, f64)> = line
            .split_whitespace()
            .map(|word| (word.chars().next().unwrap(), word[1..].parse().unwrap_or_else(|_| panic!("{line}"))))
            .collect();
        let has = |g: f64| words.contains(&('G', g));
        unit = if has(20.0) {
            25.4
        } else if has(21.0) {
            1.0
        } else {
            unit
        };
        plane = (0..3).find(|k| has(17.0 + *k as f64)).unwrap_or(plane);
        absolute = has(90.1) || (absolute && !has(91.1));
        let value = |letter: char| words.iter().find(|word| word.0 == letter).map(|word| word.1 * unit);
        let named = ['X', 'Y', 'Z'].map(value);
        if has(53.0) || has(28.0) {
            moves.push(Move::Elsewhere);
            (0..3).filter(|&k| named[k].is_some()).for_each(|k| at[k] = f64::NAN);
            continue;
        }
        if has(4.0) || named.iter().all(Option::is_none) {
            continue;
        }
        let to = std::array::from_fn(|k| named[k].unwrap_or(at[k]));
        let [a, b, _] = PLANES[plane];
        let about = (has(2.0) || has(3.0)).then(|| {
            let centre = [a, b].map(|k| {
                let by = value(['I', 'J', 'K'][k]).unwrap();
                if absolute { by } else { at[k] + by }
            });
            let arm = |of: [f64; 3]| (of[b] - centre[1]).atan2(of[a] - centre[0]);
            let turn = (arm(to) - arm(at)).rem_euclid(std::f64::consts::TAU);
            let tau = std::f64::consts::TAU;
            let turn = if !(1e-9..=tau - 1e-9).contains(&turn) { tau } else { turn };
            let angle = if has(3.0) {
                turn
            } else if turn == tau {
                -tau
            } else {
                turn - tau
            };
            (PLANES[plane], centre, angle)
        });
        moves.push(if has(0.0) { Move::Rapid(named) } else { Move::Feed(Way { from: at, to, about }) });
        at = to;
    }
    moves
}

/// Compares the corrected program with the drawn one plus the map.
fn assert_is_corrected(drawn: &RandomProgram, text: &str, error: fn(f64, f64) -> f64, seed: u64) {
    let found = read(text);
    let mut k = 0;
    for (number, wanted) in drawn.moves.iter().enumerate() {
        let place = || format!("seed {seed}, move {number} {wanted:?}\n{}", drawn.text);
        match wanted {
            Move::Feed(way) => {
                let at = |share: f64| {
                    let mut at = way.at(share);
                    at[2] -= error(at[0], at[1]);
                    at
                };
                // A first line moves the tool to the start of the corrected path.
                if let Some(Move::Feed(first)) = found.get(k)
                    && distance(first.from, at(0.0)) > 2.0 * TOLERANCE_MM
                    && distance(first.to, at(0.0)) < TOLERANCE_MM
                {
                    k += 1;
                }
                let samples = 200;
                for sample in 0..=samples {
                    let wanted = at(f64::from(sample) / f64::from(samples));
                    let off = |k: usize| match found.get(k) {
                        Some(Move::Feed(way)) => way.off(wanted),
                        _ => f64::INFINITY,
                    };
                    let mut best = off(k);
                    // The path only goes forward.
                    for next in k + 1..found.len() {
                        if best < TOLERANCE_MM + DIGIT_MM || off(next).is_infinite() {
                            break;
                        }
                        if off(next) < best || off(next) < TOLERANCE_MM + DIGIT_MM {
                            (k, best) = (next, off(next));
                        }
                    }
                    assert!(best < TOLERANCE_MM + DIGIT_MM, "{:.3} um off at {wanted:?}, {}", 1e3 * best, place());
                }
                let end = at(1.0);
                let ends =
                    |k: usize| matches!(found.get(k), Some(Move::Feed(way)) if distance(way.to, end) < TOLERANCE_MM);
                while k < found.len() && !ends(k) {
                    k += 1;
                }
                assert!(ends(k), "the end is not reached, {}", place());
                k += 1;
            }
            Move::Rapid(to) => {
                let Some(Move::Rapid(is)) = found.get(k) else { panic!("{:?} {}", found.get(k), place()) };
                let same = |k: usize| match (to[k], is[k]) {
                    (Some(a), Some(b)) => (a - b).abs() < DIGIT_MM,
                    (a, b) => a.is_some() == b.is_some(),
                };
                assert!((0..3).all(same), "{is:?} {}", place());
                k += 1;
            }
            Move::Elsewhere => {
                assert!(matches!(found.get(k), Some(Move::Elsewhere)), "{:?} {}", found.get(k), place());
                k += 1;
            }
        }
    }
    assert_eq!(k, found.len(), "seed {seed}: moves that nobody drew\n{}\n{text}", drawn.text);
}

#[test]
fn drawn_program_corrected_or_refused() {
    let (mut corrected, mut refused, mut kept) = (0, 0, 0);
    let count = seeds(60);
    for seed in 0..count {
        let drawn = drawn(seed);
        let error: fn(f64, f64) -> f64 = if seed % 4 == 0 { |_, _| 0.004 } else { error_mm };
        let bench = Shop::new(error, &drawn.text);
        match (bench.compensate(&["--tolerance-um", "0.01"]), drawn.refused) {
            (Ok(text), None) => {
                assert_is_corrected(&drawn, &text, error, seed);
                corrected += 1;
                kept += text.lines().filter(|line| line.starts_with("G2 ") || line.starts_with("G3 ")).count();
            }
            (Err(said), Some(words)) => {
                assert!(said.contains(words), "seed {seed}: {said}\n{}", drawn.text);
                refused += 1;
            }
            (Ok(_), Some(words)) => panic!("seed {seed} is not refused ({words})\n{}", drawn.text),
            (Err(said), None) => panic!("seed {seed}: {said}\n{}", drawn.text),
        }
        fs::remove_file(bench.path("base.ngc")).unwrap();
    }
    println!("{corrected} corrected, {refused} refused, {kept} arcs stayed arcs");
    assert!(corrected * 10 > count * 7 && refused > 0 && kept as u64 > count / 4);
}

//! Picture of the state machine, drawn from its transition table.
//!
//! The positions of the boxes are fixed in this file. The arrows come from the table. An arrow takes the straightest
//! way that touches no other box, and its label takes the first free place along it, so the same table gives the same
//! picture. The label of an arrow names at most two of its events; the table itself contains all of them.

use std::collections::{BTreeMap, BTreeSet};

use super::svg::{Anchor, INK, LARGE, Svg};
use regrind_cell::{State, TransitionRow};

const WIDTH_PX: f64 = 1300.0;
const HEIGHT_PX: f64 = 1260.0;
/// Size of labels.
const FINE_PX: f64 = 10.0;
/// Top of the second drawing.
const CYCLE_TOP_PX: f64 = 850.0;

/// Colours of arrows that follow an order of a person, and of arrows that show a fault. Other arrows are the normal
/// course of a run.
const ORDER: &str = "#2166ac";
const TROUBLE: &str = "#b2182b";

const ORDERS: [&str; 6] = ["start", "load_confirmed", "hold", "resume", "stop", "abort"];
const TROUBLES: [&str; 12] = [
    "compensation_refused",
    "condition_lost",
    "deadline",
    "fault",
    "link_lost",
    "not_connected",
    "obstructed",
    "record_failed",
    "refused",
    "registration_failed",
    "restarted",
    "start_unknown",
];

/// States of PackML and the centres of their boxes.
const STATES: [(&str, [f64; 2]); 15] = [
    ("Idle", [80.0, 320.0]),
    ("Starting", [240.0, 320.0]),
    ("Execute", [560.0, 320.0]),
    ("Holding", [310.0, 130.0]),
    ("Held", [560.0, 130.0]),
    ("Unholding", [810.0, 130.0]),
    ("Suspending", [310.0, 510.0]),
    ("Suspended", [560.0, 510.0]),
    ("Unsuspending", [810.0, 510.0]),
    ("Completing", [1000.0, 320.0]),
    ("Complete", [1210.0, 320.0]),
    ("Stopping", [560.0, 650.0]),
    ("Stopped", [1210.0, 650.0]),
    ("Aborting", [560.0, 770.0]),
    ("Aborted", [1210.0, 770.0]),
];

/// States in which a run is active or can continue.
const AT_WORK: [&str; 9] =
    ["Idle", "Starting", "Execute", "Holding", "Held", "Unholding", "Suspending", "Suspended", "Unsuspending"];

/// Frame around states that all have the same exit.
struct Frame {
    corner: [f64; 2],
    size: [f64; 2],
    /// States within the frame in addition to `AT_WORK`.
    and: &'static [&'static str],
    /// The two states that the exit leads to: the first if a machine must act before, the second if no machine has to
    /// act.
    to: [&'static str; 2],
    label: [&'static str; 2],
}

const FRAMES: [Frame; 2] = [
    Frame {
        corner: [20.0, 78.0],
        size: [880.0, 512.0],
        and: &[],
        to: ["Stopping", "Stopped"],
        label: ["Stop", "Stop; no job is under way"],
    },
    Frame {
        corner: [8.0, 66.0],
        size: [1072.0, 644.0],
        and: &["Completing", "Stopping"],
        to: ["Aborting", "Aborted"],
        label: ["Abort, Fault", "Abort; no machine was met"],
    },
];

/// Phases and steps within `Execute`, and the centres of their boxes within the second drawing.
const PHASES: [(&str, [f64; 2]); 22] = [
    ("Load", [0.0, 0.0]),
    ("Grind, Send", [1.0, 0.0]),
    ("Grind, Clear", [2.0, 0.0]),
    ("Grind, Prepare", [3.0, 0.0]),
    ("Grind, Start", [4.0, 0.0]),
    ("Grind, Run", [5.5, 0.0]),
    ("Grind, Acknowledge", [7.5, 0.0]),
    ("Grind, Reconcile", [4.0, 1.0]),
    ("Grind, Discard", [7.0, 1.0]),
    ("Transfer", [9.0, 0.0]),
    ("Measure, Send", [9.0, 3.0]),
    ("Measure, Clear", [8.0, 3.0]),
    ("Measure, Prepare", [7.0, 3.0]),
    ("Measure, Start", [6.0, 3.0]),
    ("Measure, Run", [5.0, 3.0]),
    ("Measure, Collect", [4.0, 3.0]),
    ("Measure, Qualify", [3.0, 3.0]),
    ("Measure, Acknowledge", [2.0, 3.0]),
    ("Measure, Reconcile", [6.0, 2.0]),
    ("Measure, Discard", [3.0, 2.0]),
    ("Register", [1.0, 3.0]),
    // The correction that this phase makes leads back to the first step of the next pass.
    ("Compensate", [0.0, 2.0]),
];

/// Half of the width and height of a box.
const HALF_STATE: [f64; 2] = [62.0, 21.0];
const HALF_PHASE: [f64; 2] = [47.0, 18.0];

/// Box with a name.
struct Node {
    name: &'static str,
    middle: [f64; 2],
    half: [f64; 2],
}

/// Arrow between two boxes, and the events that it represents.
struct Edge {
    from: usize,
    to: usize,
    events: BTreeSet<String>,
}

/// Occupied rectangle: centre, and half of width and height.
type OccupiedRectangle = ([f64; 2], [f64; 2]);

/// Draws the state machine of the cell as SVG. `rows` is its transition table.
pub fn state_picture(rows: &[TransitionRow]) -> String {
    let mut svg = Svg::new(WIDTH_PX, HEIGHT_PX);
    svg.text([20.0, 30.0], Anchor::Start, LARGE, "The cell: states");
    legend(&mut svg);
    draw_states(&mut svg, &ways(rows, |state| Some(state.name().to_string())));
    svg.text(
        [20.0, CYCLE_TOP_PX],
        Anchor::Start,
        LARGE,
        "Inside the state Execute: the phases of a cycle and the steps of a job",
    );
    let phases = ways(rows, |state| match state {
        State::Execute(phase) => Some(phase.to_string()),
        _ => None,
    });
    draw_phases(&mut svg, &phases);
    svg.finish()
}

/// Events that lead from one state to another, by the names of both states; refused events are omitted.
type TransitionEvents = BTreeMap<(String, String), BTreeSet<String>>;

fn ways(rows: &[TransitionRow], name: impl Fn(State) -> Option<String>) -> TransitionEvents {
    let mut ways = TransitionEvents::new();
    for row in rows {
        for answer in row.answers.iter().filter(|answer| !answer.is_refusal()) {
            let (Some(from), Some(to)) = (name(row.state), name(answer.next)) else { continue };
            if from != to {
                let event = row.event.split(" (").next().unwrap_or_default().to_owned();
                ways.entry((from, to)).or_default().insert(event);
            }
        }
    }
    ways
}

fn legend(svg: &mut Svg) {
    let meanings = [(ORDER, "a person orders it"), (INK, "normal course of a run"), (TROUBLE, "something went wrong")];
    for (k, (colour, meaning)) in meanings.into_iter().enumerate() {
        let x = 780.0 + 170.0 * k as f64;
        svg.arrow([x, 26.0], [x + 12.0, 26.0], [x + 24.0, 26.0], colour);
        svg.text([x + 32.0, 30.0], Anchor::Start, FINE_PX + 1.0, meaning);
    }
}

fn draw_states(svg: &mut Svg, ways: &TransitionEvents) {
    let nodes = STATES.map(|(name, middle)| Node { name, middle, half: HALF_STATE });
    let mut ways = ways.clone();
    let mut taken = boxes(&nodes);
    for frame in &FRAMES {
        let around = [&AT_WORK[..], frame.and].concat();
        let leads = |from: &&str| frame.to.iter().any(|to| ways.contains_key(&((**from).to_owned(), (*to).to_owned())));
        // A frame is drawn only for an exit that all states within it have.
        if around.iter().all(leads) {
            ways.retain(|(from, to), _| !(around.contains(&from.as_str()) && frame.to.contains(&to.as_str())));
            draw_frame(svg, frame, &mut taken);
        }
    }
    draw(svg, &nodes, &edges(&nodes, &ways), &mut taken);
    for node in &nodes {
        let fill = match node.name {
            "Complete" | "Stopped" | "Aborted" => "#cccccc",
            "Execute" => "#d1e5f0",
            _ => "#ffffff",
        };
        draw_box(svg, node, fill, &[node.name]);
    }
}

fn draw_frame(svg: &mut Svg, frame: &Frame, taken: &mut Vec<OccupiedRectangle>) {
    let Frame { corner: [left, top], size: [width, height], .. } = *frame;
    let (right, bottom) = (left + width, top + height);
    svg.polyline(&[[left, top], [right, top], [right, bottom], [left, bottom], [left, top]], "#888888", "5 4");
    let place = |name: &str| STATES.iter().find(|(state, _)| *state == name).map_or([0.0, 0.0], |(_, middle)| *middle);
    let [near, far] = frame.to.map(place);
    let to = [near[0], near[1] - HALF_STATE[1]];
    svg.arrow([near[0], bottom], [near[0], bottom], to, ORDER);
    svg.text([near[0] + 8.0, (bottom + to[1]) / 2.0 + 4.0], Anchor::Start, FINE_PX, frame.label[0]);
    let (start, end) = ([right - 200.0, bottom], [far[0] - HALF_STATE[0], far[1] - 10.0]);
    svg.arrow(start, [right - 180.0, end[1]], end, ORDER);
    svg.text([end[0] - 8.0, end[1] - 5.0], Anchor::End, FINE_PX, frame.label[1]);
    taken.push(([end[0] - 80.0, end[1] - 8.0], [80.0, 8.0]));
}

fn draw_phases(svg: &mut Svg, ways: &TransitionEvents) {
    let at = |[column, row]: [f64; 2]| [70.0 + 128.0 * column, CYCLE_TOP_PX + 80.0 + 100.0 * row];
    let nodes = PHASES.map(|(name, place)| Node { name, middle: at(place), half: HALF_PHASE });
    let mut taken = boxes(&nodes);
    draw(svg, &nodes, &edges(&nodes, ways), &mut taken);
    for node in &nodes {
        let fill = match node.name.split(',').next().unwrap_or_default() {
            "Grind" => "#fddbc7",
            "Measure" => "#d1e5f0",
            _ => "#ffffff",
        };
        let lines: Vec<&str> = node.name.split(", ").collect();
        draw_box(svg, node, fill, &lines);
    }
}

fn draw_box(svg: &mut Svg, node: &Node, fill: &str, lines: &[&str]) {
    let ([x, y], [w, h]) = (node.middle, node.half);
    svg.rectangle([x - w, y - h], [2.0 * w, 2.0 * h], fill);
    let first = y + 4.0 - 6.5 * (lines.len() - 1) as f64;
    for (k, line) in lines.iter().enumerate() {
        svg.text([x, first + 13.0 * k as f64], Anchor::Middle, FINE_PX + 1.5, line);
    }
}

fn boxes(nodes: &[Node]) -> Vec<OccupiedRectangle> {
    nodes.iter().map(|node| (node.middle, node.half)).collect()
}

/// Returns one arrow for each pair of states that has a transition in `ways`. `ways` gives the events of each
/// transition, by the names of both states. A pair is omitted if one of the states has no box in `nodes`. The arrow
/// holds the indices of both boxes and the events.
fn edges(nodes: &[Node], ways: &TransitionEvents) -> Vec<Edge> {
    let index = |name: &str| nodes.iter().position(|node| node.name == name);
    let known = ways
        .iter()
        .filter_map(|((from, to), events)| Some(Edge { from: index(from)?, to: index(to)?, events: events.clone() }));
    known.collect()
}

fn draw(svg: &mut Svg, nodes: &[Node], edges: &[Edge], taken: &mut Vec<OccupiedRectangle>) {
    let mut labels = Vec::new();
    for edge in edges {
        let both = edges.iter().any(|other| (other.from, other.to) == (edge.to, edge.from));
        let curve = route(nodes, edge, both);
        let colour = colour_of(&edge.events);
        svg.arrow(curve[0], curve[1], curve[2], colour);
        labels.push((curve, label_of(&edge.events), colour));
    }
    // Labels are drawn last, so that no arrow runs over them.
    for (curve, label, colour) in labels {
        let half = [2.75 * label.chars().count() as f64 + 1.0, 6.0];
        let place = free_place(&curve, half, taken);
        taken.push((place, half));
        svg.plate([place[0] - half[0], place[1] - half[1]], [2.0 * half[0], 2.0 * half[1]]);
        svg.coloured_text([place[0], place[1] + 3.5], FINE_PX, &label, colour);
    }
}

fn colour_of(events: &BTreeSet<String>) -> &'static str {
    let all = |known: &[&str]| events.iter().all(|event| known.contains(&event.as_str()));
    match events.iter().any(|event| ORDERS.contains(&event.as_str())) {
        true => ORDER,
        false if all(&TROUBLES) => TROUBLE,
        false => INK,
    }
}

/// Returns the label of an arrow between two states: the names of the first two of its `events`. If there are more than
/// two events, the number of the other events follows. For example, "start, resume +3" is the label for five events.
/// Orders of a person come first, then the events of normal operation, then faults.
fn label_of(events: &BTreeSet<String>) -> String {
    let rank = |event: &&String| {
        let known = |names: &[&str]| names.contains(&event.as_str());
        if known(&ORDERS) { 0 } else { 1 + u8::from(known(&TROUBLES)) }
    };
    let mut sorted: Vec<&String> = events.iter().collect();
    sorted.sort_by_key(rank);
    let named = sorted.iter().take(2).map(|event| event.as_str()).collect::<Vec<_>>().join(", ");
    if sorted.len() > 2 { format!("{named} +{}", sorted.len() - 2) } else { named }
}

/// Returns the start, the control point and the end of a quadratic Bézier curve, in pixels. The curve joins the borders
/// of the two boxes of `edge`. It is the first of several curves, from the least to the most bent, that keeps clear of
/// all other boxes in `nodes`. If every curve meets a box, returns the least bent one. `both` is true if another arrow
/// joins the same boxes in the opposite direction. Then the least bent curve is not straight, so that the two arrows do
/// not coincide.
fn route(nodes: &[Node], edge: &Edge, both: bool) -> [[f64; 2]; 3] {
    let (from, to) = (&nodes[edge.from], &nodes[edge.to]);
    let [dx, dy] = [to.middle[0] - from.middle[0], to.middle[1] - from.middle[1]];
    let length = dx.hypot(dy).max(1.0);
    let least = if both { 14.0 } else { 0.0 };
    let bows = [least, 60.0, -60.0, 100.0, -100.0, 150.0, -150.0, 220.0, -220.0];
    let curve = |bow: f64| {
        let middle = [(from.middle[0] + to.middle[0]) / 2.0, (from.middle[1] + to.middle[1]) / 2.0];
        let control = [middle[0] - bow * dy / length, middle[1] + bow * dx / length];
        [border(from, control), control, border(to, control)]
    };
    let is_free = |curve: &[[f64; 2]; 3]| {
        let others = nodes.iter().enumerate().filter(|(k, _)| *k != edge.from && *k != edge.to);
        let hits = |node: &Node| (0..=40).any(|k| within(on(curve, f64::from(k) / 40.0), node.middle, node.half, 4.0));
        !others.into_iter().any(|(_, node)| hits(node))
    };
    bows.into_iter().map(curve).find(|c| is_free(c)).unwrap_or_else(|| curve(least))
}

/// Returns the point at which the straight line from the centre of the box `node` to the point `to` leaves the box.
fn border(node: &Node, to: [f64; 2]) -> [f64; 2] {
    let [dx, dy] = [to[0] - node.middle[0], to[1] - node.middle[1]];
    let share = (node.half[0] / dx.abs()).min(node.half[1] / dy.abs()).min(1.0);
    [node.middle[0] + share * dx, node.middle[1] + share * dy]
}

/// Returns the point of a quadratic Bézier curve at the parameter `t`, from 0 at the start to 1 at the end. `[a, b, c]`
/// are the start, the control point and the end of the curve.
fn on([a, b, c]: &[[f64; 2]; 3], t: f64) -> [f64; 2] {
    let weights = [(1.0 - t) * (1.0 - t), 2.0 * t * (1.0 - t), t * t];
    std::array::from_fn(|k| weights[0] * a[k] + weights[1] * b[k] + weights[2] * c[k])
}

fn within(point: [f64; 2], middle: [f64; 2], half: [f64; 2], margin: f64) -> bool {
    (0..2).all(|k| (point[k] - middle[k]).abs() < half[k] + margin)
}

/// Returns a position, in pixels, for the centre of a label of a curve. The result is the first candidate position at
/// which the label overlaps no rectangle in `taken`. The candidates lie on the curve first, then above and below it.
/// `curve` is a quadratic Bézier curve: start, control point and end. `half` is half the width and half the height of
/// the label. If no candidate is free, returns the middle of the curve.
fn free_place(curve: &[[f64; 2]; 3], half: [f64; 2], taken: &[OccupiedRectangle]) -> [f64; 2] {
    let is_free = |place: &[f64; 2]| {
        !taken.iter().any(|(middle, other)| within(*place, *middle, [other[0] + half[0], other[1] + half[1]], 1.0))
    };
    let shares = [0.5, 0.42, 0.58, 0.34, 0.66, 0.26, 0.74];
    let asides = [0.0, -14.0, 14.0, -26.0, 26.0, -38.0];
    let places = asides.iter().flat_map(|aside| {
        shares.iter().map(move |t| {
            let [x, y] = on(curve, *t);
            [x, y + aside]
        })
    });
    places.into_iter().find(is_free).unwrap_or_else(|| on(curve, 0.5))
}

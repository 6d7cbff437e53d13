//! Alarms of a cell: the event, its consequence, the remedy, and who may clear it, in plain language.

use serde::{Deserialize, Serialize};

/// Alarm that a person must see.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Alarm {
    /// Kind of the alarm.
    pub id: AlarmId,
    /// Event, with the values of this case.
    pub what: String,
    /// Consequence of the event.
    pub consequence: String,
    /// Steps to take, in this order.
    pub remedy: Vec<String>,
    /// Role that may clear it.
    pub clears: Role,
}

/// Role that may clear an alarm.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[non_exhaustive]
pub enum Role {
    /// Nobody: it clears by itself.
    Nobody,
    /// The operator.
    Operator,
    /// The process engineer.
    ProcessEngineer,
}

macro_rules! catalogue {
    ($($(#[$doc:meta])* $id:ident { $head:literal, $consequence:literal, $clears:ident, [$($remedy:literal),+ $(,)?] })+) => {
        /// Kinds of alarm.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
        #[serde(rename_all = "snake_case")]
        pub enum AlarmId {
            $($(#[$doc])* $id,)+
        }

        impl AlarmId {
            /// All alarms, in the order of the catalogue.
            pub const ALL: &[Self] = &[$(Self::$id),+];

            /// Returns the general description of the event. Every alarm of this kind begins with it.
            pub fn head(self) -> &'static str {
                self.entry().0
            }

            /// Returns the steps to take, in this order.
            pub fn remedy(self) -> &'static [&'static str] {
                self.entry().3
            }

            /// Returns the general description, the consequence, the role that clears it, and the steps to take.
            fn entry(self) -> (&'static str, &'static str, Role, &'static [&'static str]) {
                match self {
                    $(Self::$id => ($head, $consequence, Role::$clears, &[$($remedy),+]),)+
                }
            }
        }
    };
}

catalogue! {
    /// No device answers.
    Unreachable {
        "A machine cannot be reached", "The run does not begin.", Operator,
        ["See that the machine is switched on and its control is running.", "Check the cable and the address in the cell file.",
         "Start the run again."]
    }
    /// Another device answers.
    WrongDevice {
        "Another device answers than the cell file names", "Nothing was written to it; the run does not begin.", ProcessEngineer,
        ["Compare the address in the cell file with the machine.", "See that no other device has that address.",
         "Start the run again."]
    }
    /// Sentinel registers in another word order.
    WordOrder {
        "The machine sends its registers in another word order than the cell file says",
        "Every number would be wrong, so nothing was written; the run does not begin.", ProcessEngineer,
        ["Change word_order in the cell file to the order that is named.", "Start the run again."]
    }
    /// Lengths in inches.
    Inches {
        "Lengths are in inches", "Nothing is made of them: Regrind works in millimetres.", ProcessEngineer,
        ["Set the measuring program and the control to millimetres.", "Resume to measure again, or start the run again."]
    }
    /// Machine owned by another client.
    Owned {
        "Another client has the machine", "The run does not begin.", Operator,
        ["Find the other program or panel that has the machine and let it release it.", "Start the run again."]
    }
    /// Machine that is not idle at the start.
    NotIdle {
        "A machine is not idle", "The run does not begin; nothing was changed on the machine.", Operator,
        ["Look at the machine and end or clear what it is doing, at its own panel.",
         "If it still holds the job of an interrupted run, resume that run.", "Start the run again."]
    }
    /// Lost link.
    LinkLost {
        "The link to a machine is lost", "Nothing new begins. A machine that was moving holds by itself; the cell asks it what became of its job and goes on when the link is back.", Nobody,
        ["Check the cable, the switch and whether the control is running.",
         "If the machine answers, but with an exception: compare the register map of the cell file with the machine's.",
         "Wait: the cell goes on by itself.",
         "If it cannot be mended, stop or abort the run."]
    }
    /// Fault of this program.
    ProgramFailed {
        "A part of this program has failed, and nothing speaks to a machine any more", "The machine hears no beat and holds itself by its own silence limit. The run cannot go on with it.", ProcessEngineer,
        ["Look at the machine: what runs there ends at its own panel.", "Abort the run: the other machine hears it, this one does not.",
         "Report the fault with the folder of the run.", "Begin a new run with a measurement of the part as it is."]
    }
    /// Missing supplies, or a signal out of range.
    ConditionLost {
        "A condition for the work is missing", "The cell waits, and goes on by itself when the condition is back.", Nobody,
        ["Restore air or coolant, or bring the signal that is named into its range.", "If the machine gives no number for a signal: correct its address in the cell file, or the sensor.", "Wait: the cell goes on by itself."]
    }
    /// Suspension that lasts too long.
    StaysSuspended {
        "The cause of the suspension did not go away", "The cell no longer goes on by itself.", Operator,
        ["Remove the cause.", "Resume, or stop the run."]
    }
    /// Machine in fault.
    MachineFault {
        "A machine is in fault", "Both machines were told to end by their own safe sequence; the run is over.", Operator,
        ["Look at the machine before anything else.", "Remove the cause and clear the fault at the machine.",
         "Inspect the part; what was ground cannot be undone.", "Start a new run that begins with a measurement."]
    }
    /// Machine that held without an order.
    MachineHeldItself {
        "A machine held its job without being told to", "The cell is held with it.", Operator,
        ["Find out why: feed hold at the panel, silent link, a guard.", "Resume here, not at the machine."]
    }
    /// Machine that resumed without an order.
    MachineResumedItself {
        "A held machine was let go at its own panel", "The job goes on, and the cell with it.", Operator,
        ["Hold and resume here, so that the record names who did it."]
    }
    /// Machine that moves without an order.
    MovesUnasked {
        "A machine moves that should stand", "It is told to hold, and the cell is held.", Operator,
        ["Look at the machine: who let it go?", "If it does not come to a stand, use the machine's own emergency circuit.",
         "Resume when it is known why it moved."]
    }
    /// Machine in manual mode.
    NotAutomatic {
        "A machine is not in automatic mode", "Nothing is started, and what moved is held: at its panel a person may move it to where the other one works.", Operator,
        ["Bring the machine out of the way of the other one, and turn its key to automatic.", "Resume here."]
    }
    /// No progress.
    ProgressStands {
        "A job makes no progress", "The machine answers and its job goes on; it is held if that lasts.", Nobody,
        ["Look at the machine: does it wait for something at its own panel, or cut air?", "Hold the run if you doubt it."]
    }
    /// Request refused by a machine.
    MachineRefused {
        "A machine refused what it was asked for", "The cell is held before that step.", Operator,
        ["Do what the answer of the machine asks for: mode automatic, guards closed, part clamped, payload within its limits.",
         "Resume to ask again."]
    }
    /// No answer within the time limit.
    NoAnswer {
        "A machine did not answer in time", "The cell is held before that step.", Operator,
        ["Look at the machine and its panel.", "Resume to ask again."]
    }
    /// Job that ended before it was complete.
    JobFailed {
        "A job of a machine ended before it was complete", "Its result is not used. A pass is not repeated: the part is measured as it is.",
        Operator,
        ["Look at the machine and the part.", "Resume to measure the part as it is."]
    }
    /// Implausible pass record.
    PassRecord {
        "What the grinder says of the pass cannot be", "The cell is held after it. The pass is not repeated: the part is measured as it is.",
        ProcessEngineer,
        ["Look at the part and the wheel: was this pass ground, with this map and this wheel?",
         "Compare the figure and its limit with the machine's program and the recipe.", "Resume to measure the part as it is, or stop the run."]
    }
    /// START of which it is unknown whether it was taken.
    StartUnknown {
        "It is not known whether a job was started", "START is never repeated on a guess. Nothing moves by order of the cell.", Operator,
        ["Look at the machine: does it stand still and clear of the part? Was the part touched?",
         "Resume to ask the machine again.", "If it cannot tell: `regrind confirm over --machine NAME --evidence TEXT` with what you saw; then resume to measure the part as it is.",
         "Or stop the run."]
    }
    /// Job that the machine no longer shows.
    JobVanished {
        "A machine no longer has the job that it was at", "The job is not begun again, and nothing moves by order of the cell.", Operator,
        ["Look at the machine: does it stand still and clear of the part? Was the part touched?", "Resume to ask the machine again.",
         "If it cannot tell: `regrind confirm over --machine NAME --evidence TEXT` with what you saw; then resume to measure the part as it is.",
         "Or stop the run."]
    }
    /// Failure that recurs.
    FailsAgain {
        "The same step fails again and again", "The cell is held and does not try it any more by itself.", Operator,
        ["Read the last answer: it says what does not work.", "Look at the machine, its program and its line.",
         "Resume to try it again, or stop the run."]
    }
    /// Restart of a machine during the run.
    MachineRestarted {
        "A machine was restarted in the middle of the run", "It may not know what it did. Nothing moves by order of the cell.", Operator,
        ["Look at the machine and the part.", "Resume to ask the machine what became of the job.",
         "If it cannot tell: declare the job over with what you saw, and resume to measure the part."]
    }
    /// Restart of the program during the run.
    ProgramRestarted {
        "The program was started again in the middle of the run", "The cell is held; the machines are asked what became of their jobs, and what moves is held.",
        Operator,
        ["Look at both machines: the state says what was found out, and what was not.", "Resume: the cell goes on from there."]
    }
    /// Interlock: machine not clear of the part.
    NotClear {
        "A machine is not clear of the part", "The other machine is not started.", Operator,
        ["Bring it to its parked place at its own panel.", "Resume."]
    }
    /// Gate: too little of the part measured.
    Coverage {
        "Too little of the part was measured", "Nothing is made of this measurement.", Operator,
        ["Look for coolant, swarf or a clamp on the part, and for a worn or bent stylus.", "Resume to measure again."]
    }
    /// Gate: no part found.
    NoPart {
        "No part was found where it should be", "Nothing is made of this measurement.", Operator,
        ["See whether the part is loaded and clamped, and whether it is the right one.", "Resume to measure again, or stop the run."]
    }
    /// Gate: part shifted or turned too far.
    PartMisplaced {
        "The part lies further from its expected place than the recipe allows",
        "No map is made: it would be ground in at the wrong place.", Operator,
        ["See how the part is loaded: turned round, on swarf, in another seat.", "Stop the run, load the part as drawn, and start a run that begins with a measurement.",
         "If it lay well all along, resume to measure again."]
    }
    /// Gate: control points have moved between the touches of one measurement.
    PartMoved {
        "The part is not where it was at the first touches of this measurement",
        "The repeated touches are not used: they belong to another place of the part.", Operator,
        ["Check that the part is clamped and that nobody has moved it.", "Wait until the temperature of part and room is stable.",
         "Order RESUME to measure the whole part again."]
    }
    /// Gate: wrong radius of the probe.
    ProbeRadius {
        "The radius of the probe is not the one in the recipe", "Nothing is made of this measurement: every deviation would be off by it.", ProcessEngineer,
        ["Clean the ball and the reference sphere.", "Qualify the probe on the machine, or mount the right stylus.",
         "Resume to measure again; a recipe with another radius needs a new run."]
    }
    /// Gate: contact points instead of probe centres.
    Contacts {
        "The machine gives contact points where probe centres are expected",
        "Nothing is made of this measurement: it would be off by the radius of the probe.", ProcessEngineer,
        ["Switch the radius compensation of the measuring program off.", "Resume to measure again."]
    }
    /// Gate: result of another part, plan or cycle.
    ForeignResult {
        "The result belongs to another part, plan or cycle", "Nothing is made of it.", ProcessEngineer,
        ["See which job the machine ran.", "Resume to measure again."]
    }
    /// Gate: broken result.
    BrokenResult {
        "The result is broken", "Nothing is made of it.", Operator,
        ["Read what of it cannot be: a figure or a point that cannot be comes from the probe or the measuring program, a wrong number of points from its list of targets.", "Correct that, and resume to measure again."]
    }
    /// Gate: temperature out of its window.
    Temperature {
        "The temperature was outside its window during the measurement", "Nothing is made of this measurement.", Operator,
        ["Let the part and the room settle.", "Resume to measure again."]
    }
    /// Failed registration.
    RegistrationFailed {
        "The measurement could not be registered to the nominal surface", "Nothing is made of this measurement.", ProcessEngineer,
        ["See whether the part and the nominal surface in the recipe belong together.", "Look at the points of this cycle in the run folder.",
         "Resume to measure again, or stop the run."]
    }
    /// Computation that exceeds its time limit.
    ComputationLate {
        "A computation takes longer than it may", "The cell is held before it.", ProcessEngineer,
        ["See whether the computer is overloaded.", "Resume to compute again."]
    }
    /// Directions of the pose that the surface determines weakly.
    WeakDirections {
        "The surface does not tell where on the part a correction would be ground in",
        "No correction is made. The error map of this cycle is in the run folder.", ProcessEngineer,
        ["Hold the named directions in the recipe (registration.lock), if the fixture or the reference points hold them well enough.",
         "Or measure features that hold them: edges, reference marks, a wider aperture.", "Start a new run that begins with a measurement."]
    }
    /// No map for the next pass.
    CompensationFailed {
        "There is no map for the next pass", "No further pass is ground.", ProcessEngineer,
        ["Read the reason and the figures of this cycle.", "Resume to compute again, or stop the run."]
    }
    /// Parameter of the machine beyond its tolerance.
    ParameterBeyond {
        "A parameter of the machine is further off than the recipe's tolerance of it",
        "The next pass is not begun before somebody agrees: it would be ground with that parameter corrected.", ProcessEngineer,
        ["Measure it by other means: the radius of the wheel by its profile or a touch on a reference, the setting and the part by an indicator.",
         "Is it so, resume: the next pass is ground with it, and the map is what is left.",
         "Is it not, stop the run, correct the recipe or the machine, and begin a new run; without the key in compensation.parameters all goes into the map."]
    }
    /// Response with the wrong sign.
    SignFlipped {
        "The part answered to the map the other way round", "Another pass would make it worse; the cell is held.", ProcessEngineer,
        ["Check the sign of the map at the grinder: positive leaves material.", "Do not resume before a test pass on a scrap part has shown the right sign.",
         "Stop the run."]
    }
    /// Response to a mirrored or turned map.
    Mirrored {
        "The part answered as to a mirrored or turned map", "Another pass would make it worse; the cell is held.", ProcessEngineer,
        ["Check the direction of x and y at the grinder, and how the part is turned in its fixture.",
         "Do not resume before a test pass on a scrap part has shown the right direction.", "Stop the run."]
    }
    /// Response to a map applied twice.
    Doubled {
        "The part answered to the map as if it had been applied twice", "Another pass would swing to the other side; the cell is held.", ProcessEngineer,
        ["See whether the map is in the program and in the controller's table as well, or was added to the one before: it is absolute.",
         "Do not resume before it is applied in one place only.", "Stop the run."]
    }
    /// No response to the map.
    NoEffect {
        "The part did not answer to the map", "Another pass would change nothing; the cell is held.", ProcessEngineer,
        ["See whether the wheel reached the part, and whether the grinder used the map.", "Check wheel radius and work offset.",
         "Resume for another pass, or stop the run."]
    }
    /// Part that gets worse.
    Diverging {
        "The part is getting worse", "After a second cycle that is worse the run does what the recipe says: hold or stop.", ProcessEngineer,
        ["Compare the error maps of the last cycles.", "Look for a worn wheel, a loose clamp, a change of temperature.",
         "Hold the run if you doubt the next pass."]
    }
    /// Part that no longer gets better.
    Stalled {
        "The part is no longer getting better", "The run does what the recipe says: hold or stop.", ProcessEngineer,
        ["Compare what is left with the measuring uncertainty and the repeatability of the grinder.",
         "Resume for another pass, or stop the run."]
    }
    /// Figures that prove the part neither good nor bad.
    Undecided {
        "The measurement proves the part neither good nor bad", "The run does what the recipe says: hold or stop.", ProcessEngineer,
        ["Measure with more points or less noise: a smaller uncertainty decides.",
         "Another pass would take material and is not expected to help."]
    }
    /// Part that is in tolerance only without the outliers.
    LeftOut {
        "Points were left out that no neighbour agrees with, and with them the part exceeds a limit",
        "The part is not accepted: what was touched counts until it is touched again.", Operator,
        ["Look at the places that are named, and clean them and the probe without moving the part.",
         "Resume to touch them again, with a few places around; what cannot be touched by itself is measured as a whole.",
         "If the same places are named again, they are on the part: stop the run and let quality decide."]
    }
    /// Passes used up.
    MaxCycles {
        "The recipe allows no further pass", "The run ends, not in tolerance.", ProcessEngineer,
        ["Look at the figures of the cycles.", "If they were still falling, allow more passes in the recipe and start a run that begins with a measurement."]
    }
    /// Removal budget used up.
    BudgetSpent {
        "The material that may be taken off is spent", "No further pass is ground; the run ends, not in tolerance.", ProcessEngineer,
        ["Let quality decide on the part: what was taken off cannot be put back.", "Begin the next part with more allowance."]
    }
    /// Record of the run that cannot be written.
    JournalUnwritable {
        "The record of the run cannot be written", "Nothing new begins to move: what is not recorded is not done.", ProcessEngineer,
        ["Check the run folder: permissions, network drive, disk.", "Resume."]
    }
    /// Disk full.
    DiskFull {
        "The disk is full", "Nothing new begins to move: what is not recorded is not done.", Operator,
        ["Free space on the disk of the run folder.", "Resume."]
    }
    /// Lost channel for orders.
    ControlLost {
        "The way by which orders reach the cell was taken away", "The run goes on, and the way is made again. Ctrl-C in the terminal of the run holds, twice aborts.",
        ProcessEngineer,
        ["Find out who deletes or moves files of the run folder.", "`regrind status` shows whether orders come in again.",
         "Hold the run if they do not."]
    }
    /// Hold that was not confirmed.
    HoldNotConfirmed {
        "A machine did not confirm that it holds", "Both machines are told to end by their own safe sequence.", Operator,
        ["Look at the machine.", "If it still moves, use the machine's own emergency circuit."]
    }
    /// Stop that was not confirmed.
    StopNotConfirmed {
        "Stop not confirmed: a machine did not say that it stands", "It may still be moving.", Operator,
        ["Use the machine's own emergency circuit.", "Keep away from the machine until you see that it stands.",
         "Then find out why it does not answer."]
    }
    /// End of the run after a timeout without an answer.
    WaitedTooLong {
        "Nobody answered in time", "The run ends in order.", Operator,
        ["Remove the cause of the hold and start a run that begins with a measurement."]
    }
}

impl AlarmId {
    /// Returns the general alarm of the catalogue, without the values of a case.
    pub fn in_general(self) -> Alarm {
        Alarm::of(self, "")
    }
}

impl Alarm {
    /// Builds an alarm from its entry in the catalogue and the values of a case.
    pub(super) fn of(id: AlarmId, case: impl AsRef<str>) -> Self {
        let (head, consequence, clears, remedy) = id.entry();
        let what = match case.as_ref() {
            "" => format!("{head}."),
            case => format!("{head}: {case}."),
        };
        let remedy = remedy.iter().map(|line| (*line).to_owned()).collect();
        Self { id, what, consequence: consequence.to_owned(), remedy, clears }
    }
}

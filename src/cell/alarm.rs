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
    /// Role that may clear the alarm.
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

            /// Returns the general description of the event, without values. The text of every alarm of this kind
            /// begins with this description.
            pub fn head(self) -> &'static str {
                self.entry().0
            }

            /// Returns the steps to take, in this order.
            pub fn remedy(self) -> &'static [&'static str] {
                self.entry().3
            }

            /// Returns the entry of the catalogue: general description of the event, consequence, role that may clear
            /// the alarm, and steps to take.
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
        ["Check that the machine is switched on and its control runs.", "Check the cable and the address in the cell file.",
         "Start the run again."]
    }
    /// Another device answers.
    WrongDevice {
        "A device other than the one in the cell file answers", "Nothing was written to it. The run does not begin.", ProcessEngineer,
        ["Compare the address in the cell file with the machine.", "Check that no other device has this address.",
         "Start the run again."]
    }
    /// Registers of the machine in another word order than in the cell file.
    WordOrder {
        "The word order of the registers differs from the cell file",
        "Every number would be wrong. Nothing was written. The run does not begin.", ProcessEngineer,
        ["Set word_order in the cell file to the named order.", "Start the run again."]
    }
    /// Lengths in inches.
    Inches {
        "Lengths are in inches", "They are not used: Regrind works in millimetres.", ProcessEngineer,
        ["Set the measuring program and the control to millimetres.", "Resume to measure again, or start the run again."]
    }
    /// Machine owned by another client.
    Owned {
        "Another client owns the machine", "The run does not begin.", Operator,
        ["Find the other program or panel that owns the machine, and release the machine there.", "Start the run again."]
    }
    /// Machine that is not idle at the start.
    NotIdle {
        "A machine is not idle", "The run does not begin. Nothing was changed on the machine.", Operator,
        ["Check the machine. End or clear its job at its own panel.",
         "If it still has the job of an interrupted run, resume that run.", "Start the run again."]
    }
    /// Lost link.
    LinkLost {
        "The link to a machine is lost", "Nothing new begins. A moving machine holds by itself. When the link is back, the cell asks it for the state of its job and continues.", Nobody,
        ["Check the cable and the network switch, and that the control runs.",
         "If the machine answers with an exception, compare its register map with the one in the cell file.",
         "Wait: the cell continues by itself.",
         "If the link cannot be repaired, stop or abort the run."]
    }
    /// Fault of this program.
    ProgramFailed {
        "A part of this program has failed and can no longer reach a machine", "The machine receives no heartbeat and holds at its own silence limit. The run cannot continue with it.", ProcessEngineer,
        ["Check the machine. End its job at its own panel.", "Abort the run. The abort reaches the other machine only.",
         "Report the fault, with the run folder.", "Start a new run that begins with a measurement of the part as it is."]
    }
    /// Missing supplies, or a signal out of range.
    ConditionLost {
        "A required condition is missing", "The cell waits. It continues by itself when the condition is back.", Nobody,
        ["Restore air or coolant, or bring the named signal into its range.", "If the machine returns no number for a signal, correct its address in the cell file, or repair the sensor.", "Wait: the cell continues by itself."]
    }
    /// Suspension that lasts too long.
    StaysSuspended {
        "The cause of the suspension remains", "The cell no longer continues by itself.", Operator,
        ["Remove the cause.", "Resume, or stop the run."]
    }
    /// Machine in fault.
    MachineFault {
        "A machine is in fault", "Both machines get ABORT and run their own safe sequence. The run is over.", Operator,
        ["Check the machine first.", "Remove the cause and clear the fault at the machine.",
         "Inspect the part: ground material cannot be restored.", "Start a new run that begins with a measurement."]
    }
    /// Machine that held without an order.
    MachineHeldItself {
        "A machine held its job without an order", "The cell is held, too.", Operator,
        ["Find the cause: feed hold at the panel, a silent link, or a guard.", "Resume here, not at the machine."]
    }
    /// Machine that resumed without an order.
    MachineResumedItself {
        "A held machine was resumed at its own panel", "The job and the cell continue.", Operator,
        ["Hold and resume here, so that the record names the person."]
    }
    /// Machine that moves without an order.
    MovesUnasked {
        "A machine moves without an order", "It is ordered to hold, and the cell is held.", Operator,
        ["Check the machine, and find the cause of the motion.", "If it does not stop, use the machine's own emergency circuit.",
         "Resume when the cause is known."]
    }
    /// Machine in manual mode.
    NotAutomatic {
        "A machine is not in automatic mode", "Nothing starts, and a moving machine is held: a person at the panel can move this machine into the work space of the other one.", Operator,
        ["Move the machine clear of the other one, and turn its key to automatic.", "Resume here."]
    }
    /// No progress.
    ProgressStands {
        "A job makes no progress", "The machine answers, and its job continues. If this lasts, the cell holds it.", Nobody,
        ["Check the machine: does it wait at its own panel, or cut air?", "If in doubt, hold the run."]
    }
    /// Request refused by a machine.
    MachineRefused {
        "A machine refused a request", "The cell is held before this step.", Operator,
        ["Meet the condition in the answer of the machine: automatic mode, guards closed, part clamped, payload within its limits.",
         "Resume to send the request again."]
    }
    /// No answer within the time limit.
    NoAnswer {
        "A machine did not answer in time", "The cell is held before this step.", Operator,
        ["Check the machine and its panel.", "Resume to send the request again."]
    }
    /// Job that ended before it was complete.
    JobFailed {
        "A job of a machine ended before it was complete", "Its result is not used. A pass is not repeated: the part is measured as it is.",
        Operator,
        ["Check the machine and the part.", "Resume to measure the part as it is."]
    }
    /// Implausible pass record.
    PassRecord {
        "The pass record of the grinder is implausible", "The cell is held after the pass. The pass is not repeated: the part is measured as it is.",
        ProcessEngineer,
        ["Check the part and the wheel: was this pass ground, with this map and this wheel?",
         "Compare the value and its limit with the machine's program and the recipe.", "Resume to measure the part as it is, or stop the run."]
    }
    /// START command with an unknown result: the machine may have started.
    StartUnknown {
        "It is unknown whether a job was started", "The cell does not repeat START and orders no motion.", Operator,
        ["Check the machine: is it at rest and clear of the part? Was the part touched?",
         "Resume to ask the machine again.", "If it cannot answer, describe what you saw: `regrind confirm over --machine NAME --evidence TEXT`. Then resume to measure the part as it is.",
         "Or stop the run."]
    }
    /// Job that the machine no longer shows.
    JobVanished {
        "A machine no longer has its job", "The cell does not start the job again and orders no motion.", Operator,
        ["Check the machine: is it at rest and clear of the part? Was the part touched?", "Resume to ask the machine again.",
         "If it cannot answer, describe what you saw: `regrind confirm over --machine NAME --evidence TEXT`. Then resume to measure the part as it is.",
         "Or stop the run."]
    }
    /// Failure that recurs.
    FailsAgain {
        "The same step fails repeatedly", "The cell is held and no longer retries by itself.", Operator,
        ["Read the last answer: it names the failure.", "Check the machine, its program and its connection.",
         "Resume to retry, or stop the run."]
    }
    /// Restart of a machine during the run.
    MachineRestarted {
        "A machine was restarted during the run", "It may no longer know its job. The cell orders no motion.", Operator,
        ["Check the machine and the part.", "Resume to ask the machine for the state of the job.",
         "If it cannot answer, declare the job over, describe what you saw, and resume to measure the part."]
    }
    /// Restart of the program during the run.
    ProgramRestarted {
        "The program was restarted during the run", "The cell is held. It asks the machines for the state of their jobs, and holds a machine that moves.",
        Operator,
        ["Check both machines. The state of the cell shows what is confirmed and what is not.", "Resume: the cell continues from there."]
    }
    /// Interlock: machine not clear of the part.
    NotClear {
        "A machine is not clear of the part", "The other machine is not started.", Operator,
        ["Move it to its park position at its own panel.", "Resume."]
    }
    /// Gate: too little of the part measured.
    Coverage {
        "Too little of the part was measured", "This measurement is not used.", Operator,
        ["Check the part for coolant, swarf or a clamp, and the stylus for wear or bending.", "Resume to measure again."]
    }
    /// Gate: no part found.
    NoPart {
        "No part was found at its expected place", "This measurement is not used.", Operator,
        ["Check that the right part is loaded and clamped.", "Resume to measure again, or stop the run."]
    }
    /// Gate: part shifted or turned too far.
    PartMisplaced {
        "The part is further from its expected place than the recipe allows",
        "No map is computed: it would be ground at the wrong place.", Operator,
        ["Check how the part is loaded: turned, on swarf, or in another seat.", "Stop the run, load the part as drawn, and start a run that begins with a measurement.",
         "If it was loaded correctly, resume to measure again."]
    }
    /// Gate: repeated touches of control points differ from the first touches: the part has moved during the
    /// measurement.
    PartMoved {
        "The part is not where it was at the first touches of this measurement",
        "The repeated touches are not used: they belong to another place of the part.", Operator,
        ["Check that the part is clamped and was not moved.", "Wait until the temperature of part and room is stable.",
         "Resume to measure the whole part again."]
    }
    /// Gate: wrong radius of the probe.
    ProbeRadius {
        "The radius of the probe differs from the recipe", "This measurement is not used: every deviation would be wrong by the difference.", ProcessEngineer,
        ["Clean the probe ball and the reference sphere.", "Qualify the probe on the machine, or mount the right stylus.",
         "Resume to measure again. A recipe with another radius requires a new run."]
    }
    /// Gate: contact points instead of probe centres.
    Contacts {
        "The machine returns contact points instead of probe centres",
        "This measurement is not used: it would be wrong by the radius of the probe.", ProcessEngineer,
        ["Switch off the radius compensation of the measuring program.", "Resume to measure again."]
    }
    /// Gate: result of another part, plan or cycle.
    ForeignResult {
        "The result belongs to another part, plan or cycle", "It is not used.", ProcessEngineer,
        ["Check which job the machine ran.", "Resume to measure again."]
    }
    /// Gate: broken result.
    BrokenResult {
        "The result is invalid", "It is not used.", Operator,
        ["Read the reason. An impossible value or point comes from the probe or the measuring program. A wrong number of points comes from the list of targets in that program.", "Correct the cause, and resume to measure again."]
    }
    /// Gate: temperature out of its window.
    Temperature {
        "The temperature was outside its window during the measurement", "This measurement is not used.", Operator,
        ["Wait until the temperature of part and room is stable.", "Resume to measure again."]
    }
    /// Failed registration.
    RegistrationFailed {
        "The measurement could not be registered to the nominal surface", "This measurement is not used.", ProcessEngineer,
        ["Check that the nominal surface in the recipe belongs to this part.", "Check the points of this cycle in the run folder.",
         "Resume to measure again, or stop the run."]
    }
    /// Computation that exceeds its time limit.
    ComputationLate {
        "A computation exceeds its time limit", "The cell is held before it.", ProcessEngineer,
        ["Check whether the computer is overloaded.", "Resume to compute again."]
    }
    /// Directions of the pose that the surface determines weakly.
    WeakDirections {
        "The surface does not determine the position of a correction on the part",
        "No correction is computed. The error map of this cycle is in the run folder.", ProcessEngineer,
        ["Lock the named directions in the recipe (registration.lock), if the fixture or the reference points define them well enough.",
         "Or measure features that determine them: edges, reference marks, a wider aperture.", "Start a new run that begins with a measurement."]
    }
    /// No map for the next pass.
    CompensationFailed {
        "There is no map for the next pass", "No further pass is ground.", ProcessEngineer,
        ["Read the reason and the figures of this cycle.", "Resume to compute again, or stop the run."]
    }
    /// Parameter of the machine beyond its tolerance.
    ParameterBeyond {
        "The error of a machine parameter exceeds its tolerance in the recipe",
        "The next pass waits for the approval of a person: it would be ground with the corrected parameter.", ProcessEngineer,
        ["Measure the parameter by other means: the radius of the wheel by its profile or a touch on a reference, the setting and the part by an indicator.",
         "If the estimate is right, resume: the next pass is ground with the corrected parameter, and the map corrects the remaining error.",
         "If it is wrong, stop the run, correct the recipe or the machine, and start a new run. Without the key in compensation.parameters, the map corrects the whole error."]
    }
    /// Response of the part with the wrong sign.
    SignFlipped {
        "The part responded to the map with the opposite sign", "Another pass would make it worse. The cell is held.", ProcessEngineer,
        ["Check the sign of the map at the grinder: positive leaves material.", "Do not resume before a test pass on a scrap part has shown the right sign.",
         "Stop the run."]
    }
    /// Response to a mirrored or turned map.
    Mirrored {
        "The part responded as to a mirrored or rotated map", "Another pass would make it worse. The cell is held.", ProcessEngineer,
        ["Check the direction of x and y at the grinder, and how the part is turned in its fixture.",
         "Do not resume before a test pass on a scrap part has shown the right direction.", "Stop the run."]
    }
    /// Response to a map applied twice.
    Doubled {
        "The part responded as if the map was applied twice", "Another pass would overshoot to the other side. The cell is held.", ProcessEngineer,
        ["Check whether the map is both in the program and in the controller's table, or was added to the previous map. The map is absolute.",
         "Do not resume before it is applied in one place only.", "Stop the run."]
    }
    /// No response to the map.
    NoEffect {
        "The part did not respond to the map", "Another pass would change nothing. The cell is held.", ProcessEngineer,
        ["Check whether the wheel reached the part and whether the grinder used the map.", "Check wheel radius and work offset.",
         "Resume for another pass, or stop the run."]
    }
    /// Part that gets worse.
    Diverging {
        "The part gets worse", "After two worse cycles in a row, the run holds or stops, as the recipe defines.", ProcessEngineer,
        ["Compare the error maps of the last cycles.", "Check for a worn wheel, a loose clamp or a change of temperature.",
         "If in doubt about the next pass, hold the run."]
    }
    /// Part that no longer gets better.
    Stalled {
        "The part no longer improves", "The run holds or stops, as the recipe defines.", ProcessEngineer,
        ["Compare the remaining error with the measuring uncertainty and the repeatability of the grinder.",
         "Resume for another pass, or stop the run."]
    }
    /// Figures that prove the part neither good nor bad.
    Undecided {
        "The measurement proves the part neither good nor bad", "The run holds or stops, as the recipe defines.", ProcessEngineer,
        ["Measure with more points or less noise: a smaller uncertainty decides.",
         "Another pass would remove material and is not expected to help."]
    }
    /// Part that is in tolerance only without the outliers.
    LeftOut {
        "Outliers deviate from all neighbours, and with them the part exceeds a limit",
        "The part is not accepted: an outlier counts until its place is touched again.", Operator,
        ["Check the named places. Clean them and the probe without moving the part.",
         "Resume to touch them again, with a few places around each. If they cannot be touched alone, the whole part is measured.",
         "If the same places are named again, the defects are on the part: stop the run, and let quality decide."]
    }
    /// Passes used up.
    MaxCycles {
        "The recipe allows no further pass", "The run ends. The part is not in tolerance.", ProcessEngineer,
        ["Check the figures of the cycles.", "If they still fall, allow more passes in the recipe, and start a run that begins with a measurement."]
    }
    /// Removal budget used up.
    BudgetSpent {
        "The removal budget is spent", "No further pass is ground. The run ends. The part is not in tolerance.", ProcessEngineer,
        ["Let quality decide on the part: removed material cannot be restored.", "Begin the next part with more allowance."]
    }
    /// Record of the run that cannot be written.
    JournalUnwritable {
        "The record of the run cannot be written", "No new motion begins before it can be recorded.", ProcessEngineer,
        ["Check the run folder: permissions, network drive, disk.", "Resume."]
    }
    /// Disk full.
    DiskFull {
        "The disk is full", "No new motion begins before it can be recorded.", Operator,
        ["Free space on the disk of the run folder.", "Resume."]
    }
    /// Lost channel for orders.
    ControlLost {
        "The channel for orders to the cell is lost", "The run continues, and the channel is opened again. Ctrl-C in the terminal of the run holds, twice aborts.",
        ProcessEngineer,
        ["Find the person or program that deletes or moves files of the run folder.", "Check with `regrind status` whether orders reach the cell again.",
         "If they do not, hold the run."]
    }
    /// Hold that was not confirmed.
    HoldNotConfirmed {
        "A machine did not confirm that it holds", "Both machines get ABORT and run their own safe sequence.", Operator,
        ["Check the machine.", "If it still moves, use the machine's own emergency circuit."]
    }
    /// Stop that was not confirmed.
    StopNotConfirmed {
        "Stop not confirmed: a machine did not report that it is at rest", "It may still be moving.", Operator,
        ["Use the machine's own emergency circuit.", "Keep away from the machine until you see that it is at rest.",
         "Then find the reason why it does not answer."]
    }
    /// End of the run after a timeout without an answer.
    WaitedTooLong {
        "No person answered in time", "The run ends in order.", Operator,
        ["Remove the cause of the hold and start a run that begins with a measurement."]
    }
}

impl AlarmId {
    /// Returns an alarm of this kind with its general text, for the list of all alarms. The text contains no machine
    /// and no value, because no event has occurred.
    pub fn generic_alarm(self) -> Alarm {
        Alarm::new(self, "")
    }
}

impl Alarm {
    /// Builds the alarm `id` from its entry in the catalogue. `case` states what happened this time, with the machine
    /// and the values, and is appended to the general description after a colon. With an empty `case`, the text is the
    /// general description alone.
    pub(super) fn new(id: AlarmId, case: impl AsRef<str>) -> Self {
        let (head, consequence, clears, remedy) = id.entry();
        let what = match case.as_ref() {
            "" => format!("{head}."),
            case => format!("{head}: {case}."),
        };
        let remedy = remedy.iter().map(|line| (*line).to_owned()).collect();
        Self { id, what, consequence: consequence.to_owned(), remedy, clears }
    }
}

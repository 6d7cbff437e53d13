//! Alarms of a cell: the event, its consequence, the remedy, and who may clear it, in plain language.

use serde::{Deserialize, Serialize};

/// Alarm that a person must see.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Alarm {
    /// Kind of the alarm.
    pub id: AlarmId,
    /// Event, with the values of this case.
    #[serde(rename = "what")]
    pub event: String,
    /// Consequence of the event.
    pub consequence: String,
    /// Steps to take, in this order.
    pub remedy: Vec<String>,
    /// Role that may clear the alarm.
    #[serde(rename = "clears")]
    pub cleared_by: Role,
}

/// Role that may clear an alarm.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
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
        #[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
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
        "The device that answers is not the device in the cell file", "Nothing was written to this device. The run does not begin.", ProcessEngineer,
        ["Compare the address in the cell file with the address of the machine.", "Check that no other device has this address.",
         "Start the run again."]
    }
    /// Registers of the machine in another word order than in the cell file.
    WordOrder {
        "The word order of the registers differs from the cell file",
        "Every number from the machine would be misread. Nothing was written to the machine. The run does not begin.", ProcessEngineer,
        ["Set word_order in the cell file to the order that this alarm names.", "Start the run again."]
    }
    /// Lengths in inches.
    Inches {
        "Lengths are in inches", "These lengths are not used: Regrind works in millimetres.", ProcessEngineer,
        ["Set the measuring program and the control to millimetres.", "Resume to measure again. If the run has not begun, start the run again."]
    }
    /// Machine owned by another client.
    Owned {
        "Another client owns the machine", "The run does not begin.", Operator,
        ["Find the other program or panel that owns the machine, and release the machine there.", "Start the run again."]
    }
    /// Machine that is not idle at the start.
    NotIdle {
        "A machine is not idle", "The run does not begin. Nothing was changed on the machine.", Operator,
        ["Check the machine. End or clear the job at the panel of the machine.",
         "If the machine still has the job of an interrupted run, do not start a new run: continue the interrupted run with `regrind resume RUN`.", "Start the run again."]
    }
    /// Lost link.
    LinkLost {
        "The link to a machine is lost", "No new step begins. A moving machine holds by itself. When the link is back, the cell asks the machine for the state of its job and continues.", Nobody,
        ["Check the cable and the network switch. Check that the control of the machine runs.",
         "If the machine answers with a Modbus exception, compare the register map in the cell file with the register map of the machine.",
         "Wait: the cell continues by itself.",
         "If the link cannot be repaired, stop or abort the run."]
    }
    /// Fault of this program.
    ProgramFailed {
        "A part of the Regrind program has failed and can no longer reach a machine", "Regrind no longer sends its sign of life (heartbeat) to this machine. When the time limit of the machine for the heartbeat is over, the machine holds by itself. The run cannot continue with this machine.", ProcessEngineer,
        ["Check the machine. End the job at the panel of the machine.", "Abort the run. The order ABORT reaches only the other machine.",
         "Report this fault of the Regrind program. Add the run folder to the report.", "Start a new run that begins with a measurement of the part as it is."]
    }
    /// Missing supplies, or a signal out of range.
    ConditionLost {
        "A required condition is missing", "The cell waits until the condition is met, then the cell continues by itself.", Nobody,
        ["Restore air or coolant, or bring the named signal into its range.", "If the machine returns no number for a signal, correct the address of the signal in the cell file, or repair the sensor.", "Wait: the cell continues by itself."]
    }
    /// Suspension that lasts too long.
    StaysSuspended {
        "The cause of the suspension remains", "The cell is held and no longer continues by itself. A person must resume the run.", Operator,
        ["Remove the cause.", "Resume, or stop the run."]
    }
    /// Machine in fault.
    MachineFault {
        "A machine is in fault", "Both machines receive the order ABORT and run their own safe sequence. The run is over.", Operator,
        ["Check the machine first.", "Remove the cause and clear the fault at the machine.",
         "Inspect the part: removed material cannot be restored.", "Start a new run that begins with a measurement."]
    }
    /// Machine that held without an order.
    MachineHeldItself {
        "A machine put its job on hold without an order", "The cell is held, too.", Operator,
        ["Find the cause: feed hold at the panel, an interrupted link, or an open guard.", "Resume in Regrind, not at the machine."]
    }
    /// Machine that resumed without an order.
    MachineResumedItself {
        "A held machine was resumed at its own panel", "The job and the cell continue.", Operator,
        ["Next time, hold and resume in Regrind, not at the panel: then the record names the person."]
    }
    /// Machine that moves without an order.
    MovesUnasked {
        "A machine moves without an order", "The cell orders the machine to hold, and the cell is held.", Operator,
        ["Check the machine, and find the cause of the motion.", "If the machine does not stop, use the machine's own emergency circuit.",
         "Resume when the cause is known."]
    }
    /// Machine in manual mode.
    NotAutomatic {
        "A machine is not in automatic mode", "No job starts, and a moving machine is held. The reason: in manual mode, a person at the panel can move a machine into the work space of the other machine.", Operator,
        ["Move the machine out of the work space of the other machine. Turn the mode key of the machine to automatic.", "Resume in Regrind."]
    }
    /// No progress.
    ProgressStands {
        "A job makes no progress", "The machine answers and reports a running job. If the job still makes no progress after the time in this alarm, the cell holds the machine.", Nobody,
        ["Check the machine. Does the machine wait for a person at its panel, or does the wheel run without contact to the part?", "If in doubt, hold the run."]
    }
    /// Request refused by a machine.
    MachineRefused {
        "A machine refused a request", "The cell is held. The refused step is not done.", Operator,
        ["Read the answer of the machine and meet the condition that this answer names. Examples: automatic mode, guards closed, part clamped, map or plan within the limits of the machine.",
         "Resume to send the request again."]
    }
    /// No answer within the time limit.
    NoAnswer {
        "A machine did not answer in time", "The cell is held. The step that waits for the answer is not complete.", Operator,
        ["Check the machine and its panel.", "Resume to send the request again."]
    }
    /// Job that ended before it was complete.
    JobFailed {
        "A job of a machine ended before it was complete", "The result of the job is not used. A pass is not repeated: the next step measures the part in its present state.",
        Operator,
        ["Check the machine and the part.", "Resume to measure the part as it is."]
    }
    /// Implausible pass record.
    PassRecord {
        "The pass record of the grinder is implausible", "The cell is held after the pass. The pass is not repeated: the part is measured as it is.",
        ProcessEngineer,
        ["Check the part and the wheel. Was the pass ground? Did the grinder use the map of this cycle and the wheel in the recipe?",
         "Compare the value and the limit in this alarm with the program of the machine and with the recipe.", "Resume to measure the part as it is, or stop the run."]
    }
    /// START command with an unknown result: the machine may have started.
    StartUnknown {
        "It is unknown whether a job was started", "The cell does not send the START order again, and orders no motion.", Operator,
        ["Check the machine: is it at rest and clear of the part? Was the part touched?",
         "Resume to ask the machine again.", "If the machine cannot answer, make sure that the job is over. Then run this command, with the machine in place of NAME and your observation in place of TEXT: `regrind confirm over --machine NAME --evidence TEXT`. Then resume to measure the part as it is.",
         "Or stop the run."]
    }
    /// Job that the machine no longer shows.
    JobVanished {
        "A machine no longer reports its job", "The cell does not start the job again and orders no motion.", Operator,
        ["Check the machine: is it at rest and clear of the part? Was the part touched?", "Resume to ask the machine again.",
         "If the machine cannot answer, make sure that the job is over. Then run this command, with the machine in place of NAME and your observation in place of TEXT: `regrind confirm over --machine NAME --evidence TEXT`. Then resume to measure the part as it is.",
         "Or stop the run."]
    }
    /// Failure that recurs.
    FailsAgain {
        "The same step fails repeatedly", "The cell is held and no longer retries the step by itself.", Operator,
        ["Read the last reason in this alarm. This reason names the failure.", "Check the machine, the program of the machine and the connection to the machine.",
         "Resume to retry, or stop the run."]
    }
    /// Restart of a machine during the run.
    MachineRestarted {
        "A machine was restarted during the run", "The machine may no longer know its job. The cell orders no motion.", Operator,
        ["Check the machine and the part.", "Resume to ask the machine for the state of the job.",
         "If the machine cannot answer, make sure that the job is over. Then run this command, with the machine in place of NAME and your observation in place of TEXT: `regrind confirm over --machine NAME --evidence TEXT`. Then resume to measure the part."]
    }
    /// Restart of the program during the run.
    ProgramRestarted {
        "The Regrind program was restarted during the run", "The cell is held. The cell asks both machines for the state of their jobs, and holds a machine that moves.",
        Operator,
        ["Check both machines. If a machine has not confirmed that it is at rest, `regrind status` names this machine.", "Resume: the cell continues the run from the states that the machines report."]
    }
    /// Interlock: machine not clear of the part.
    NotClear {
        "A machine is not clear of the part", "The other machine is not started.", Operator,
        ["Use the panel of the machine to move the machine to its park position.", "Resume."]
    }
    /// Gate: too little of the part measured.
    Coverage {
        "Too little of the part was measured", "This measurement is not used.", Operator,
        ["Check whether coolant, swarf or a clamp covers the part. Check whether the stylus is worn or bent.", "Resume to measure again."]
    }
    /// Gate: no part found.
    NoPart {
        "No part was found at its expected place", "This measurement is not used.", Operator,
        ["Check that the right part is loaded and clamped.", "Resume to measure again, or stop the run."]
    }
    /// Gate: part shifted or turned too far.
    PartMisplaced {
        "The part is further from its expected place than the recipe allows",
        "No map is computed: a pass with this map would grind the wrong places of the part.", Operator,
        ["Check whether the part is turned, lies on swarf, or is in the wrong seat of the fixture.", "If the part was loaded wrongly, stop the run, load the part as the drawing shows, and start a run that begins with a measurement.",
         "If the part was loaded correctly, resume to measure again."]
    }
    /// Gate: repeated touches of control points differ from the first touches: the part has moved during the
    /// measurement.
    PartMoved {
        "The part has moved since the first touches of this measurement",
        "The repeated touches are not used: the probe made these touches after the part had moved.", Operator,
        ["Find out why the part has moved, for example because a clamp was loose or a person pushed the part. Then clamp the part.", "Wait until the temperature of part and room is stable.",
         "Resume to measure the whole part again."]
    }
    /// Gate: wrong radius of the probe.
    ProbeRadius {
        "The radius of the probe differs from the recipe", "This measurement is not used: every deviation would be wrong by the difference of the two radii.", ProcessEngineer,
        ["Clean the probe ball and the reference sphere.", "Qualify the probe on the machine, or mount the right stylus.",
         "Resume to measure again. If the radius in the recipe is wrong, correct the recipe and start a new run."]
    }
    /// Gate: contact points instead of probe centres.
    Contacts {
        "The machine returns contact points instead of probe centres",
        "This measurement is not used: every point would be wrong by the radius of the probe.", ProcessEngineer,
        ["Switch off the radius compensation of the measuring program.", "Resume to measure again."]
    }
    /// Gate: result of another part, plan or cycle.
    ForeignResult {
        "The result of the machine belongs to another part, measuring plan or cycle", "This result is not used.", ProcessEngineer,
        ["Check which job the machine ran.", "Resume to measure again."]
    }
    /// Gate: broken result.
    BrokenResult {
        "The result is invalid", "This result is not used.", Operator,
        ["Read the reason in this alarm. An impossible value or point comes from the probe or the measuring program. A wrong number of points comes from the list of targets in the measuring program.", "Correct the cause, and resume to measure again."]
    }
    /// Gate: temperature out of its window.
    Temperature {
        "The temperature was outside its limits during the measurement", "This measurement is not used.", Operator,
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
        "A computation exceeds its time limit", "The cell is held before this computation.", ProcessEngineer,
        ["Check whether the computer is overloaded.", "Resume to compute again."]
    }
    /// Directions of the pose that the surface determines weakly.
    WeakDirections {
        "The shape of the surface does not determine the position of the part well enough for a correction",
        "No correction is computed. The error map of this cycle is in the run folder.", ProcessEngineer,
        ["Lock the directions that this alarm names (recipe key registration.lock), if the fixture or the reference points define these directions well enough.",
         "Or measure features that determine these directions: edges, reference marks or a wider aperture.", "Start a new run that begins with a measurement."]
    }
    /// No map for the next pass.
    CompensationFailed {
        "No map could be computed for the next pass", "No further pass is ground.", ProcessEngineer,
        ["Read the reason in this alarm, and the figures of this cycle.", "Resume to compute again, or stop the run."]
    }
    /// Parameter of the machine beyond its tolerance.
    ParameterBeyond {
        "The error of a machine parameter exceeds its tolerance in the recipe",
        "The next pass waits for the approval of a person: this pass would be ground with the corrected parameter.", ProcessEngineer,
        ["Measure the parameter with another method. For the radius of the wheel, use the profile of the wheel or a touch on a reference. For the setting of the wheel and the tilt of the part, use a dial indicator.",
         "If the estimate is right, resume: the next pass is ground with the corrected parameter, and the map corrects the remaining error.",
         "If the estimate is wrong, stop the run, correct the recipe or the machine, and start a new run. If you remove the key of this parameter from compensation.parameters in the recipe, the map corrects the whole error."]
    }
    /// Response of the part with the wrong sign.
    SignFlipped {
        "The part responded to the map with the opposite sign", "Another pass would make the part worse. The cell is held.", ProcessEngineer,
        ["Check the sign of the map at the grinder: at a positive value, the grinder must leave more material on the part.", "Do not resume before a test pass on a scrap part has shown that a positive value of the map leaves more material.",
         "Stop the run."]
    }
    /// Response to a mirrored or turned map.
    Mirrored {
        "The part responded as if the grinder had used a mirrored or rotated map", "Another pass would make the part worse. The cell is held.", ProcessEngineer,
        ["Check the direction of x and y at the grinder, and how the part is turned in its fixture.",
         "Do not resume before a test pass on a scrap part has shown the right direction.", "Stop the run."]
    }
    /// Response to a map applied twice.
    Doubled {
        "The part responded as if the map was applied twice", "Another pass would correct too much and reverse the error. The cell is held.", ProcessEngineer,
        ["Check whether the map is in the program and also in the controller's table. Check also whether the map was added to the previous map. A new map must replace the previous map.",
         "Do not resume before the map is applied in one place only.", "Stop the run."]
    }
    /// No response to the map.
    NoEffect {
        "The part did not respond to the map", "Until the cause is removed, another pass changes nothing. The cell is held.", ProcessEngineer,
        ["Check whether the wheel reached the part and whether the grinder used the map.", "Check wheel radius and work offset.",
         "If the cause is removed, resume for another pass. Otherwise, stop the run."]
    }
    /// Part that gets worse.
    Diverging {
        "The part gets worse", "If the part gets worse in two cycles in a row, the run holds or stops, as the recipe defines.", ProcessEngineer,
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
        "The measurement does not prove whether the part is good or bad", "The run holds or stops, as the recipe defines.", ProcessEngineer,
        ["Measure with more points or less noise: a smaller uncertainty can show whether the part is good or bad.",
         "Another pass would remove material, but would probably not improve the part."]
    }
    /// Part that is in tolerance only without the outliers.
    LeftOut {
        "The part exceeds a limit because of outliers, which are points that deviate from all their neighbours",
        "The part is not accepted: an outlier counts as a real point of the part until the probe has touched the place of the outlier again.", Operator,
        ["Check the places that this alarm names. Clean these places and the probe without moving the part.",
         "Resume to touch these places and a few places around each of them again. If these places cannot be touched alone, the whole part is measured.",
         "If the same places are named again, the defects are on the part: stop the run, and let the quality department decide about the part."]
    }
    /// Passes used up.
    MaxCycles {
        "The recipe allows no further pass", "The run ends. The part is not in tolerance.", ProcessEngineer,
        ["Check the figures of the cycles.", "If PV and RMS still decrease from cycle to cycle, allow more passes in the recipe (max_cycles), and start a run that begins with a measurement."]
    }
    /// Removal budget used up.
    BudgetSpent {
        "The removal budget is spent", "No further pass is ground. The run ends. The part is not in tolerance.", ProcessEngineer,
        ["Let the quality department decide about the part: removed material cannot be restored.", "Begin the next part with more material above the nominal surface (allowance)."]
    }
    /// Record of the run that cannot be written.
    JournalUnwritable {
        "The record of the run cannot be written", "No new motion begins until the record can be written.", ProcessEngineer,
        ["Check the run folder: permissions, network drive, disk.", "Resume."]
    }
    /// Disk full.
    DiskFull {
        "The disk is full", "No new motion begins until the record of the run can be written.", Operator,
        ["Free space on the disk of the run folder.", "Resume."]
    }
    /// Lost channel for orders.
    ControlLost {
        "The channel for orders to the cell is lost", "The run continues, and Regrind opens the channel again. Until then, use the terminal of the run: press Ctrl-C once to hold the run, twice to abort the run.",
        ProcessEngineer,
        ["Find the person or program that deletes or moves files of the run folder.", "Check with `regrind status` whether orders reach the cell again.",
         "If orders still do not reach the cell, hold the run: press Ctrl-C once at the terminal of the run."]
    }
    /// Hold that was not confirmed.
    HoldNotConfirmed {
        "A machine did not confirm that it holds", "Both machines receive the order ABORT and run their own safe sequence.", Operator,
        ["Check the machine.", "If the machine still moves, use the machine's own emergency circuit."]
    }
    /// Stop that was not confirmed.
    StopNotConfirmed {
        "Stop not confirmed: a machine did not report that it is at rest", "This machine may still be moving.", Operator,
        ["Use the machine's own emergency circuit.", "Keep away from the machine until you see that it is at rest.",
         "Then find the reason why the machine does not answer."]
    }
    /// End of the run after a timeout without an answer.
    WaitedTooLong {
        "No person answered in time", "The run ends. A machine that has a job is stopped.", Operator,
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
        let event = match case.as_ref() {
            "" => format!("{head}."),
            case => format!("{head}: {case}."),
        };
        let remedy = remedy.iter().map(|line| (*line).to_owned()).collect();
        Self { id, event, consequence: consequence.to_owned(), remedy, cleared_by: clears }
    }
}

//! One schedule: its seed determines everything that happens in it.

use std::fmt;
use std::path::Path;
use std::time::Duration;

use rand::rngs::StdRng;
use rand::{RngExt as _, SeedableRng as _};
use regrind::journal::free_bytes;
use regrind_sim::dme::faults::Fault as OfDme;
use regrind_sim::rsh::faults::Fault as OfRsh;

use crate::checker::{Evidence, check};
use crate::cue::{Cue, When, any_length};
use crate::happening::Happening;
use crate::ledger::Disk;
use crate::net::Weather;
use crate::part::RequiredQuality;
use regrind_testcell::wire_faults::Fault;

/// Maximum number of lives of the program that are cut short.
const MAX_DEATHS: usize = 3;

/// First seed of the schedules whose machines have other protocols than Modbus.
pub const OTHER_WIRES: u64 = 1_000_000;

/// First seed of the schedules in which a machine forgets its job.
pub const FORGETFUL: u64 = 2_000_000;

/// First seed of the schedules in which nothing fails but the disk.
pub const FULL_DISK: u64 = 3_000_000;

/// First seed of the schedules in which machines report false values in their status and results.
pub const LIARS: u64 = 4_000_000;

/// Status block and header of a result: the first register, and the number of registers.
const STATUS: (u16, usize) = (64, 48);
const HEADER: (u16, usize) = (400, 56);

/// Fault of a server of I++ DME: the command, the number of them before the fault, and the fault.
pub type DmeFault = (&'static str, u32, OfDme);

/// Fault of linuxcncrsh: the line, the number of them before the fault, and the fault.
pub type RshFault = (&'static str, u32, OfRsh);

/// Schedule of a seed.
#[derive(Clone, Debug)]
pub struct Schedule {
    pub seed: u64,
    /// Speed of the machines' time relative to the cell's: a pass takes from some hundredths of a second to ten
    /// seconds.
    pub speed: f64,
    /// True if the machines rely on the program that nothing begins twice.
    pub trusting: bool,
    /// Bits per second of the one serial line that both machines share; none if they are on a network.
    pub baud: Option<u32>,
    /// Share of the requests to the machines that have a fault.
    pub fault_share: f64,
    pub faults: Vec<Fault>,
    /// Faults of the CMM's I++ DME server; none if the CMM uses Modbus.
    pub dme: Option<Vec<DmeFault>>,
    /// Faults of the grinder's LinuxCNC; none if the grinder uses Modbus.
    pub rsh: Option<Vec<RshFault>>,
    pub acts: Vec<(When, Act)>,
    /// Effects before which the lives of the program end, one for each life.
    pub deaths: Vec<u64>,
    pub wanted: RequiredQuality,
}

/// External act on the cell.
#[derive(Clone, Debug)]
pub enum Act {
    Weather {
        wire: usize,
        weather: Weather,
        lasts: Duration,
    },
    Disk {
        disk: Disk,
        lasts: Duration,
    },
    Freeze {
        machine: usize,
        lasts: Duration,
    },
    Reboot {
        machine: usize,
    },
    /// Its application restarts with its old boot id, and knows no job that it began.
    Forget {
        machine: usize,
    },
    Manual {
        machine: usize,
        lasts: Duration,
    },
    Supplies {
        machine: usize,
        lasts: Duration,
    },
    Stranger {
        machine: usize,
        aborts: bool,
    },
    /// Another client writes a command with a number near the highest possible one.
    HighNumber {
        machine: usize,
    },
    /// A machine at rest begins to move without an order.
    Stray {
        machine: usize,
        lasts: Duration,
    },
    /// A person presses the button that resumes a held machine.
    PressStart {
        machine: usize,
    },
    /// The payload that comes into force next is changed after it was checked.
    Spoil {
        machine: usize,
    },
    /// The computer sleeps; the machines do not.
    Suspend {
        lasts: Duration,
    },
    /// The stop circuit of a machine opens for a moment.
    EmergencyStop {
        machine: usize,
    },
    /// A register of a block that is read has a false value.
    Lie {
        machine: usize,
        block: u16,
        at: usize,
        word: u16,
        lasts: Duration,
    },
    Order(&'static str),
}

impl Act {
    /// Returns the time for which this act can delay requests to the machines; none if it does not.
    pub fn hinders(&self, by_lines: bool) -> Option<Duration> {
        match self {
            Self::Weather { lasts, .. } | Self::Suspend { lasts } => Some(*lasts),
            Self::Freeze { lasts, .. } if by_lines => Some(*lasts),
            Self::Reboot { .. } if by_lines => Some(Duration::from_secs(1)),
            _ => None,
        }
    }
}

impl Schedule {
    /// Draws the schedule of a seed. Every kind of fault occurs in some schedules and not in others, so that no fault
    /// hides another.
    pub fn drawn(seed: u64) -> Self {
        match seed {
            LIARS.. => Self::lied_to(seed),
            FULL_DISK.. => Self::on_a_full_disk(seed),
            FORGETFUL.. => Self::forgetful(seed),
            OTHER_WIRES.. => Self::by_other_wires(seed),
            _ => Self::by_modbus(seed),
        }
    }

    /// Draws a run in which nothing fails but the disk, now and then for a while, and in which a person holds or ends
    /// the run in the meantime.
    fn on_a_full_disk(seed: u64) -> Self {
        const CUES: [Cue; 7] =
            [Cue::Loaded, Cue::Prepared, Cue::StartOnRecord, Cue::Begins, Cue::Complete, Cue::Complete, Cue::Ordered];
        let mut chance = StdRng::seed_from_u64(seed);
        let mut acts = Vec::new();
        for _ in 0..chance.random_range(1..4) {
            let (cue, nth) = (CUES[chance.random_range(0..CUES.len())], chance.random_range(1..=5));
            let at = |pause| When::After(cue, nth, pause);
            let pause = any_length(&mut chance, 1.0);
            let lasts = Duration::from_secs_f64(chance.random_range(0.1..20.0));
            acts.push((at(pause), Act::Disk { disk: Disk { failing_share: 1.0, ..Disk::SOUND }, lasts }));
            if chance.random::<f64>() < 0.5 {
                let order = ["hold", "resume", "resume", "stop"][chance.random_range(0..4)];
                acts.push((at(pause + any_length(&mut chance, 8.0)), Act::Order(order)));
            }
        }
        let speed = [2000.0, 400.0, 60.0][chance.random_range(0..3)];
        Self { speed, acts, wanted: RequiredQuality::Good, ..Self::with_deaths(seed, Vec::new()) }
    }

    /// Draws a run in which registers of the status and of the header of a result have false values for a while: one
    /// field selected by the seed, and others in addition.
    fn lied_to(seed: u64) -> Self {
        let mut chance = StdRng::seed_from_u64(seed);
        let mut acts = Vec::new();
        for k in 0..chance.random_range(1..4_u64) {
            let number = (seed - LIARS + 31 * k) as usize % (STATUS.1 + HEADER.1);
            let (block, at) = match number.checked_sub(STATUS.1) {
                None => (STATUS.0, number),
                Some(of_header) => (HEADER.0, of_header),
            };
            let word = [0, 1, 2, 5, 7, 0x7fff, 0x8000, 0xffff, chance.random()][chance.random_range(0..9)];
            let cue = [Cue::Loaded, Cue::Prepared, Cue::StartSent, Cue::Begins, Cue::Begins, Cue::Held, Cue::Complete]
                [chance.random_range(0..7)];
            let when = When::After(cue, chance.random_range(1..=4), any_length(&mut chance, 3.0));
            let lasts = any_length(&mut chance, 20.0);
            acts.push((when, Act::Lie { machine: chance.random_range(0..2), block, at, word, lasts }));
        }
        let speed = [2000.0, 400.0, 60.0][chance.random_range(0..3)];
        Self { speed, acts, wanted: RequiredQuality::Good, ..Self::with_deaths(seed, Vec::new()) }
    }

    /// Returns true if machines report false values.
    pub fn lies(&self) -> bool {
        self.seed >= LIARS
    }

    /// Returns true if nothing fails but the disk.
    pub fn disk_fails_alone(&self) -> bool {
        (FULL_DISK..LIARS).contains(&self.seed)
    }

    /// Draws the acts as for Modbus. Once or twice a machine forgets the current or the last job.
    fn forgetful(seed: u64) -> Self {
        let mut chance = StdRng::seed_from_u64(seed ^ 0x0F02_6E70);
        let mut drawn = Self { speed: [400.0, 60.0, 10.0][chance.random_range(0..3)], ..Self::by_modbus(seed) };
        for _ in 0..chance.random_range(1..3) {
            let cue = [Cue::Begins, Cue::Begins, Cue::StartSent, Cue::Held, Cue::Complete][chance.random_range(0..5)];
            let when = When::After(cue, chance.random_range(1..=4), any_length(&mut chance, 5.0));
            drawn.acts.push((when, Act::Forget { machine: chance.random_range(0..2) }));
        }
        drawn
    }

    /// Draws the acts as for Modbus. The protocols, and the faults at their servers, come from separate random
    /// generators.
    fn by_other_wires(seed: u64) -> Self {
        let mut chance = StdRng::seed_from_u64(seed ^ 0xD3E0_0000);
        let mut drawn = Self { baud: None, ..Self::by_modbus(seed) };
        let by_lines = [[true, false], [false, true], [true, true]][chance.random_range(0..3)];
        drawn.dme = by_lines[0].then(|| dme_faults(&mut chance));
        drawn.rsh = by_lines[1].then(|| rsh_faults(&mut chance));
        if chance.random::<f64>() < 0.2 {
            let when = When::drawn(&mut chance, 12.0);
            drawn.acts.push((when, Act::EmergencyStop { machine: usize::from(by_lines[1]) }));
        }
        drawn
    }

    fn by_modbus(seed: u64) -> Self {
        let mut chance = StdRng::seed_from_u64(seed);
        let speed = [2000.0, 400.0, 60.0, 10.0][chance.random_range(0..4)];
        let trusting = chance.random::<f64>() < 0.5;
        let baud = (chance.random::<f64>() < 0.25).then(|| [115_200, 57_600][chance.random_range(0..2)]);
        let deaths = if chance.random::<f64>() < 0.4 { chance.random_range(1..=MAX_DEATHS) } else { 0 };
        let deaths = (0..deaths).map(|_| chance.random_range(1..700)).collect::<Vec<u64>>();
        let drawn = Self { seed, speed, trusting, baud, deaths, ..Self::with_deaths(seed, Vec::new()) };
        let drawn = Self { wanted: RequiredQuality::Good, ..drawn };
        match chance.random_range(0..10) {
            0 if drawn.deaths.is_empty() => {
                let acts = if chance.random::<f64>() < 0.5 { asleep(&mut chance) } else { astray(&mut chance) };
                return Self { baud: None, acts, ..drawn };
            }
            0 => return drawn,
            1 | 2 => return Self { baud: None, acts: hasty(&mut chance), ..drawn },
            // A pass takes long enough to lose and restore a line within it.
            3 | 4 => {
                return Self {
                    speed: [20.0, 10.0, 5.0][chance.random_range(0..3)],
                    acts: broken_off(&mut chance),
                    ..drawn
                };
            }
            _ => {}
        }
        let fault_share = [0.0, 0.0, 0.003, 0.02, 0.08][chance.random_range(0..5)];
        let faults = faults(&mut chance, baud.is_some());
        Self { fault_share, faults, acts: acts(&mut chance, speed), ..drawn }
    }

    /// Returns a schedule without faults except that the program dies before these effects.
    pub fn with_deaths(seed: u64, deaths: Vec<u64>) -> Self {
        Self {
            seed,
            speed: 2000.0,
            trusting: false,
            baud: None,
            fault_share: 0.0,
            faults: Vec::new(),
            dme: None,
            rsh: None,
            acts: Vec::new(),
            deaths,
            wanted: RequiredQuality::Perfect,
        }
    }

    /// Returns true if the only faults are deaths of the program.
    pub fn dies_alone(&self) -> bool {
        self.acts.is_empty() && self.fault_share == 0.0 && self.servers_go_well()
    }

    /// Returns true if there are no faults at the servers of lines.
    pub fn servers_go_well(&self) -> bool {
        self.dme.as_ref().is_none_or(Vec::is_empty) && self.rsh.as_ref().is_none_or(Vec::is_empty)
    }

    /// Runs the schedule and checks the promises.
    ///
    /// # Errors
    ///
    /// Returns the broken promise.
    pub fn run(&self) -> Result<Tally, String> {
        let (evidence, home) = self.happen();
        let checked = check(&evidence);
        regrind_testutils::keep::keep(home.path());
        checked.map(|()| evidence.tally.clone())
    }

    /// Runs the schedule and returns all events, line by line.
    pub fn traced(&self) -> Vec<String> {
        self.happen().0.trace()
    }

    /// Returns the number of effects of the program if nothing kills it.
    pub fn effects(&self) -> u64 {
        self.happen().0.effects
    }

    fn happen(&self) -> (Evidence, tempfile::TempDir) {
        // Use memory if there is room for the data of a run: nothing here has to outlast the process.
        let memory = Path::new("/dev/shm");
        let has_room = free_bytes(memory).is_ok_and(|bytes| bytes > 48 << 20);
        let home = has_room.then(|| tempfile::tempdir_in(memory).ok()).flatten();
        let home = home.unwrap_or_else(|| tempfile::tempdir().unwrap());
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().start_paused(true).build().unwrap();
        let evidence = runtime.block_on(async { Happening::new(self, home.path()).go().await });
        (evidence, home)
    }
}

impl fmt::Display for Schedule {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "seed {}", self.seed)?;
        if self.wanted == RequiredQuality::Perfect {
            write!(f, ", deaths {:?}", self.deaths)?;
        }
        Ok(())
    }
}

/// Draws the communication faults of a schedule.
fn faults(chance: &mut StdRng, is_serial: bool) -> Vec<Fault> {
    let all = [
        Fault::DropRequest,
        Fault::DropReply,
        Fault::DelayReply(Duration::from_millis(300)),
        Fault::DelayReply(Duration::from_millis(900)),
        Fault::DuplicateReply,
        Fault::Truncate(5),
        Fault::Fewer,
        Fault::Extra(vec![0, 1, 2]),
        Fault::Noise(vec![9, 9, 9]),
        Fault::WrongTransaction,
        Fault::WrongUnit,
        Fault::WrongFunction,
        Fault::Exception(6),
        Fault::Exception(4),
        Fault::Exception(2),
        Fault::Split(Duration::from_millis(2)),
        Fault::FlipCrc,
        Fault::Disconnect(0),
        Fault::Disconnect(8),
        Fault::TornStatus,
        Fault::CarryOutAgain(3),
    ];
    let mut drawn: Vec<Fault> = all.into_iter().filter(|_| chance.random::<f64>() < 0.4).collect();
    if !is_serial && chance.random::<f64>() < 0.3 {
        drawn.push(Fault::Silence);
    }
    drawn
}

/// Draws the faults of a server of I++ DME.
fn dme_faults(chance: &mut StdRng) -> Vec<DmeFault> {
    let late = |s: f64| OfDme::LateAcknowledgement(Duration::from_secs_f64(s));
    let anywhere = [late(0.3), late(2.0), late(6.0), OfDme::NoCompletion, OfDme::Disconnect, OfDme::EmergencyStop];
    let with_data =
        [OfDme::Twice, OfDme::Split, OfDme::Reordered, OfDme::UnaskedQuality, OfDme::Garbled, OfDme::Stranger];
    let at_all = ["GoTo", "GoTo", "PtMeas", "PtMeas", "SetProp", "Get", "ChangeTool", "StartSession", "ClearAllErrors"];
    let mut faults = Vec::new();
    for _ in 0..[0, 0, 1, 2, 4, 8][chance.random_range(0..6)] {
        let skip = chance.random_range(0..120);
        faults.push(match chance.random_range(0..10) {
            0..4 => (at_all[chance.random_range(0..at_all.len())], skip, anywhere[chance.random_range(0..6)].clone()),
            4..8 => (
                ["PtMeas", "PtMeas", "Get"][chance.random_range(0..3)],
                skip,
                with_data[chance.random_range(0..6)].clone(),
            ),
            8 => ("AbortE", 0, OfDme::AbortIgnored),
            _ => ("PtMeas", skip, OfDme::Severity([0, 1, 3, 9][chance.random_range(0..4)])),
        });
    }
    faults
}

/// Draws the faults of linuxcncrsh.
fn rsh_faults(chance: &mut StdRng) -> Vec<RshFault> {
    const SETS: [&str; 9] =
        ["set run", "set run", "set open", "set open", "set mode", "set mdi", "set enable", "set pause", "set abort"];
    let late = |s: f64| OfRsh::Late(Duration::from_secs_f64(s));
    let all = [
        OfRsh::Lost,
        OfRsh::Unanswered,
        late(0.5),
        late(4.0),
        OfRsh::Refused,
        OfRsh::DoneAndRefused,
        OfRsh::Ignored,
        OfRsh::Fails,
        OfRsh::CutBefore,
        OfRsh::CutAfter,
        OfRsh::UnmatchedLines,
    ];
    let mut faults = Vec::new();
    for _ in 0..[0, 0, 1, 2, 4, 8][chance.random_range(0..6)] {
        faults.push(match chance.random_range(0..10) {
            0..7 => {
                let line = SETS[chance.random_range(0..SETS.len())];
                (line, chance.random_range(0..4), all[chance.random_range(0..all.len())].clone())
            }
            7 => ("set run", chance.random_range(0..3), OfRsh::Limit(chance.random_range(0..1000))),
            8 => ("hello", chance.random_range(0..2), all[chance.random_range(0..all.len())].clone()),
            _ => ("get", chance.random_range(0..600), all[chance.random_range(0..all.len())].clone()),
        });
    }
    faults
}

/// Draws the acts and their times. Faults seldom come alone.
fn acts(chance: &mut StdRng, speed: f64) -> Vec<(When, Act)> {
    // Approximate duration of a run without faults.
    let span_s = 8.0 + 320.0 / speed;
    let mut acts = Vec::new();
    for _ in 0..chance.random_range(0..6) {
        let when = When::drawn(chance, span_s);
        let first = if chance.random::<f64>() < 0.15 { order(chance) } else { act(chance) };
        acts.push((when, first));
        while chance.random::<f64>() < 0.5 {
            let next = if chance.random::<f64>() < 0.5 { order(chance) } else { act(chance) };
            acts.push((when.and_soon(chance), next));
        }
    }
    acts
}

/// Draws times at which the computer sleeps, longer than the decision loop is allowed to hang.
fn asleep(chance: &mut StdRng) -> Vec<(When, Act)> {
    let nap = |chance: &mut StdRng| Act::Suspend { lasts: Duration::from_secs(2) + any_length(chance, 4.0) };
    (0..chance.random_range(2..8)).map(|_| (When::drawn(chance, 12.0), nap(chance))).collect()
}

/// Draws times at which a machine begins to move by itself soon after the cell was held.
fn astray(chance: &mut StdRng) -> Vec<(When, Act)> {
    let mut acts = Vec::new();
    for nth in 1..=chance.random_range(2..5) {
        acts.push((When::After(Cue::Begins, nth, any_length(chance, 0.3)), Act::Order("hold")));
        let (machine, lasts) = (chance.random_range(0..2), Duration::from_secs(1) + any_length(chance, 4.0));
        // After the cell shows it.
        let pause = Duration::from_millis(50) + any_length(chance, 0.3);
        acts.push((When::After(Cue::Held, nth, pause), Act::Stray { machine, lasts }));
    }
    acts
}

/// Draws times at which a connection breaks exactly when a machine receives a command to move or to hold, and soon
/// returns. The last command can stay in transit for a long time.
fn broken_off(chance: &mut StdRng) -> Vec<(When, Act)> {
    const CUES: [Cue; 7] =
        [Cue::Prepared, Cue::Prepared, Cue::StartSent, Cue::StartSent, Cue::Begins, Cue::Begins, Cue::Ordered];
    let late = Weather { slow_share: 1.0, slow: Duration::from_secs(12), ..Weather::FAIR };
    let silent = Weather { silent: true, ..Weather::FAIR };
    let down = Weather { down: true, ..Weather::FAIR };
    let mut acts = Vec::new();
    for _ in 0..chance.random_range(1..4) {
        let cue = CUES[chance.random_range(0..CUES.len())];
        let (nth, wire) = (chance.random_range(1..=4), chance.random_range(0..2));
        let at = |pause| When::After(cue, nth, pause);
        let mut pause = if chance.random::<f64>() < 0.5 { Duration::ZERO } else { any_length(chance, 1.0) };
        if chance.random::<f64>() < 0.3 {
            let disk = Disk { slow_share: 1.0, slow: Duration::from_secs(8), ..Disk::SOUND };
            acts.push((at(Duration::ZERO), Act::Disk { disk, lasts: any_length(chance, 1.0) }));
        }
        if chance.random::<f64>() < 0.4 {
            let lasts = any_length(chance, 0.03);
            acts.push((at(pause), Act::Weather { wire, weather: late, lasts }));
            pause += lasts;
        }
        if chance.random::<f64>() < 0.6 {
            let after = pause + any_length(chance, 0.3);
            acts.push((at(after), Act::Order(["hold", "hold", "resume"][chance.random_range(0..3)])));
        }
        for _ in 0..chance.random_range(1..3) {
            let weather = [down, down, silent, late][chance.random_range(0..4)];
            let lasts = Duration::from_secs_f64(chance.random_range(0.2..4.0));
            acts.push((at(pause), Act::Weather { wire, weather, lasts }));
            pause += lasts;
        }
    }
    acts
}

/// Draws times at which a machine or the disk fails while a person gives one order after the other.
fn hasty(chance: &mut StdRng) -> Vec<(When, Act)> {
    let mut acts = Vec::new();
    for _ in 0..chance.random_range(1..4) {
        let cue = [Cue::StartOnRecord, Cue::Begins, Cue::Begins, Cue::Holding][chance.random_range(0..4)];
        let nth = chance.random_range(1..=4);
        let mut pause = any_length(chance, 0.3);
        let (machine, lasts) = (chance.random_range(0..2), any_length(chance, 20.0));
        let hinder = match chance.random_range(0..3) {
            0 => Act::Freeze { machine, lasts },
            1 => Act::Disk { disk: Disk { failing_share: 1.0, ..Disk::SOUND }, lasts },
            _ => Act::Disk { disk: Disk { slow_share: 1.0, slow: Duration::from_secs(8), ..Disk::SOUND }, lasts },
        };
        acts.push((When::After(cue, nth, pause), hinder));
        for _ in 0..chance.random_range(1..4) {
            pause += any_length(chance, 1.0);
            acts.push((When::After(cue, nth, pause), order(chance)));
        }
    }
    acts
}

fn act(chance: &mut StdRng) -> Act {
    let machine = chance.random_range(0..2);
    let lasts = any_length(chance, 20.0);
    let second = Duration::from_secs(1);
    match chance.random_range(0..20) {
        0 => Act::Weather { wire: machine, weather: Weather { down: true, ..Weather::FAIR }, lasts },
        1 | 2 => Act::Weather { wire: machine, weather: Weather { silent: true, ..Weather::FAIR }, lasts },
        3 | 4 => {
            let slow_share = [0.02, 0.2, 1.0][chance.random_range(0..3)];
            let slow = second.mul_f64([0.4, 1.2, 6.0][chance.random_range(0..3)]);
            Act::Weather { wire: machine, weather: Weather { slow_share, slow, ..Weather::FAIR }, lasts }
        }
        5 => Act::Disk { disk: Disk { failing_share: 1.0, ..Disk::SOUND }, lasts },
        6 => Act::Disk { disk: Disk { failing_share: 0.2, unknown_share: 0.2, ..Disk::SOUND }, lasts },
        7 | 8 => {
            let slow_share = [0.5, 1.0][chance.random_range(0..2)];
            Act::Disk { disk: Disk { slow_share, slow: 8 * second, ..Disk::SOUND }, lasts }
        }
        9 | 10 => Act::Freeze { machine, lasts },
        11 => Act::Reboot { machine },
        12 => Act::Manual { machine, lasts },
        13 => Act::Supplies { machine, lasts },
        14 => Act::Stranger { machine, aborts: chance.random::<f64>() < 0.2 },
        15 => Act::HighNumber { machine },
        // The decision loop counts as hung after two seconds.
        16 => Act::Suspend { lasts: lasts + 2 * second },
        17 => Act::Stray { machine, lasts },
        18 => Act::PressStart { machine },
        _ => Act::Spoil { machine },
    }
}

fn order(chance: &mut StdRng) -> Act {
    Act::Order(["hold", "hold", "abort", "abort", "stop", "resume"][chance.random_range(0..6)])
}

/// Counters of the results of schedules.
#[derive(Clone, Debug, Default)]
pub struct Tally {
    pub runs: u64,
    pub accepted: u64,
    pub lives: u64,
    pub passes: u64,
    pub records: u64,
    pub faults: u64,
    pub orders: u64,
    pub simulated: Duration,
}

impl Tally {
    pub fn add(&mut self, other: &Self) {
        self.runs += other.runs;
        self.accepted += other.accepted;
        self.lives += other.lives;
        self.passes += other.passes;
        self.records += other.records;
        self.faults += other.faults;
        self.orders += other.orders;
        self.simulated += other.simulated;
    }
}

impl fmt::Display for Tally {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { runs, accepted, lives, passes, records, faults, orders, simulated } = self;
        write!(
            f,
            "{runs} parts ({accepted} accepted) in {lives} lives of the program, {passes} passes, {records} records, {faults} faults of \
             the wire, {orders} orders, {:.1} h of the cell's time",
            simulated.as_secs_f64() / 3600.0
        )
    }
}

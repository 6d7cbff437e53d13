//! Machine as a Modbus client sees it: blocks of registers to read and to write, and time that passes.
//!
//! [`SimulatedMachine`] is the whole simulated machine without its wire. Every answer depends only on what was read,
//! written and ticked, so a test simulates hours in a moment and is repeatable. Real time enters only through
//! [`SimulatedMachine::tick`].

use std::time::Duration;

use crate::body::{Kind, Physics};
use crate::command::{Mode, State};
use crate::event_log::{HandshakeEvent, LogEntry, Observer};
use crate::handshake::Handshake;
use crate::options::{Block, MachineOptions, RegisterLayout};
use crate::register_encoding::RegisterBlock;
use crate::transfer::{Inbox, page_image, slots_image};

/// Modbus exception code of a refused request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Exception {
    /// The function is not one of 3, 6 and 16.
    Function = 1,
    /// The address is outside the blocks, read only, or across a border.
    Address = 2,
    /// The content is not acceptable.
    Value = 3,
    /// The machine's application does not read its inbox.
    Busy = 6,
    /// No machine has this unit id.
    Target = 0x0B,
}

/// Maximum time slice of a tick.
const SLICE: Duration = Duration::from_millis(20);
/// Interval of the machine's own beat.
const BEAT: Duration = Duration::from_millis(100);

/// Simulated machine: registers, handshake and physics.
pub struct SimulatedMachine {
    handshake: Handshake,
    options: MachineOptions,
    inbox: Inbox,
    sync: [u16; 2],
    /// Beat block as written last by any client.
    beat_block: [u16; 3],
    /// Counter of the owner's last beat.
    beat: u16,
    command: [u16; 20],
    inbox_header: [u16; 24],
    inbox_page: [u16; 120],
    select: [u16; 2],
    machine_beat: u16,
    beat_echo: u16,
    beat_due: Duration,
    status: Vec<u16>,
    torn: bool,
    frozen: bool,
    /// True if a command block was written while the application was frozen.
    unseen: bool,
}

impl SimulatedMachine {
    /// Creates a simulated machine that has just been switched on. `body` simulates the physics of the machine.
    /// `boot_id` identifies this start of the machine's program and should differ at every start; 0 is replaced by 1.
    /// `options` sets the properties of the machine's interface, for example the addresses of the registers.
    pub fn new(body: Box<dyn Physics>, boot_id: u32, options: MachineOptions) -> Self {
        let mut machine = Self {
            handshake: Handshake::new(body, boot_id, &options),
            options,
            inbox: Inbox::default(),
            sync: [0; 2],
            beat_block: [0; 3],
            beat: 0,
            command: [0; 20],
            inbox_header: [0; 24],
            inbox_page: [0; 120],
            select: [0; 2],
            machine_beat: 0,
            beat_echo: 0,
            beat_due: BEAT,
            status: vec![0; 48],
            torn: false,
            frozen: false,
            unseen: false,
        };
        machine.publish();
        machine
    }

    /// Reads `count` registers from `address` on.
    ///
    /// # Errors
    /// A register is in no block, or the count is 0 or more than 125.
    pub fn read(&mut self, address: u16, count: u16) -> Result<Vec<u16>, Exception> {
        if !(1..=125).contains(&count) {
            return Err(Exception::Value);
        }
        let count = usize::from(count);
        let mut registers = Vec::with_capacity(count);
        while registers.len() < count {
            let at = usize::from(address) + registers.len();
            let (block, offset, length) = self.options.layout.find(at).ok_or(Exception::Address)?;
            let end = length.min(offset + count - registers.len());
            registers.extend(&self.image(block)[offset..end]);
        }
        Ok(self.to_line_order(registers))
    }

    /// Swaps the two bytes of each register if the machine's options require it (`swaps_bytes`). This converts
    /// registers from the machine's byte order to the byte order on the line, or back.
    fn to_line_order(&self, mut registers: Vec<u16>) -> Vec<u16> {
        if self.options.swaps_bytes {
            registers.iter_mut().for_each(|register| *register = register.swap_bytes());
        }
        registers
    }

    /// Writes `values` to consecutive registers. `address` is the address of the first register. The machine has
    /// already reacted to the values when this function returns. A frozen application ([`Self::freeze`]) reacts to a
    /// command only later.
    ///
    /// # Errors
    /// Returns [`Exception::Address`] if a register is in no block that a client may write, or if the write crosses the
    /// border of a block. Returns [`Exception::Value`] if there are not 1 to 123 values, or if the machine does not
    /// accept the values. Returns [`Exception::Busy`] if a payload is written while the application is frozen.
    pub fn write(&mut self, address: u16, values: &[u16]) -> Result<(), Exception> {
        if !(1..=123).contains(&values.len()) {
            return Err(Exception::Value);
        }
        let values = &self.to_line_order(values.to_vec())[..];
        let (block, offset, length) = self.options.layout.find(address.into()).ok_or(Exception::Address)?;
        let writable = if block == Block::Sync { 2 } else { length };
        if offset + values.len() > writable {
            return Err(Exception::Address);
        }
        match block {
            Block::Sync => self.sync[offset..offset + values.len()].copy_from_slice(values),
            Block::Beat => self.write_beat(values)?,
            Block::Command => self.write_command(offset, values),
            Block::InboxHeader => self.write_header(offset, values)?,
            Block::InboxPage => self.write_page(offset, values)?,
            Block::OutboxSelect => self.select[offset..offset + values.len()].copy_from_slice(values),
            Block::Identity
            | Block::Status
            | Block::InForce
            | Block::InboxState
            | Block::OutboxHeader
            | Block::OutboxPage => return Err(Exception::Address),
        }
        self.publish();
        Ok(())
    }

    /// Advances the machine by the real time `elapsed_real`. The physics of a running job advances by this time
    /// multiplied by the speed of [`Self::set_speed`]. While the application is frozen, only the clock of the machine
    /// advances.
    pub fn tick(&mut self, elapsed_real: Duration) {
        let mut left = elapsed_real;
        while !left.is_zero() {
            let slice = left.min(SLICE);
            left -= slice;
            if self.frozen {
                self.handshake.now += slice;
                continue;
            }
            if std::mem::take(&mut self.unseen) {
                self.handshake.read_command(&self.command);
            }
            self.beat_echo = self.beat;
            self.beat_due = self.beat_due.saturating_sub(slice);
            if self.beat_due.is_zero() {
                self.machine_beat = self.machine_beat.wrapping_add(1);
                self.beat_due = BEAT;
            }
            self.handshake.advance_time(slice);
        }
        self.publish();
    }

    /// Stores a heartbeat that a client has written. `values` are a counter (one register) and the id of the client
    /// (two registers). The heartbeat counts only if this client owns the machine and the counter has changed.
    ///
    /// # Errors
    /// Returns [`Exception::Value`] if `values` does not have exactly three registers.
    fn write_beat(&mut self, values: &[u16]) -> Result<(), Exception> {
        let [count, high, low]: [u16; 3] = values.try_into().map_err(|_| Exception::Value)?;
        self.beat_block = [count, high, low];
        if self.handshake.is_owned_by(self.options.word_order.to_u32([high, low])) && self.beat != count {
            self.beat = count;
            self.handshake.beat();
        }
        Ok(())
    }

    fn write_command(&mut self, offset: usize, values: &[u16]) {
        self.command[offset..offset + values.len()].copy_from_slice(values);
        if offset + values.len() < self.command.len() {
            return;
        }
        if self.frozen {
            self.unseen = true;
        } else {
            self.handshake.read_command(&self.command);
        }
    }

    fn write_header(&mut self, offset: usize, values: &[u16]) -> Result<(), Exception> {
        if self.frozen {
            return Err(Exception::Busy);
        }
        let whole: [u16; 24] = values.try_into().map_err(|_| Exception::Value)?;
        let (order, limit) = (self.options.word_order, self.options.payload_limit_bytes);
        if offset != 0 || self.handshake.is_moving() || !self.inbox.header(order, &whole, self.kind(), limit) {
            return Err(Exception::Value);
        }
        self.inbox_header = whole;
        Ok(())
    }

    fn write_page(&mut self, offset: usize, values: &[u16]) -> Result<(), Exception> {
        if self.frozen {
            return Err(Exception::Busy);
        }
        let order = self.options.word_order;
        if offset != 0 || values.len() < 9 || (self.handshake.is_moving() && !self.inbox.has_page(order, values)) {
            return Err(Exception::Value);
        }
        let arrived = self.inbox.page(order, values).ok_or(Exception::Value)?;
        self.inbox_page = [0; 120];
        self.inbox_page[..values.len()].copy_from_slice(values);
        if let Some(arrived) = arrived
            && let Err(answer) = self.handshake.put_in_force(arrived)
        {
            self.inbox.refuse(answer);
        }
        Ok(())
    }

    fn image(&mut self, block: Block) -> Vec<u16> {
        let order = self.options.word_order;
        match block {
            Block::Identity => self.identity_image(),
            Block::Sync => vec![self.sync[0], self.sync[1], !self.sync[0], !self.sync[1]],
            Block::Beat => self.beat_block.to_vec(),
            Block::Command => self.command.to_vec(),
            Block::Status => self.status_image(),
            Block::InForce => {
                let image = slots_image(order, &self.handshake.slots);
                self.handshake.slots_were_read();
                image
            }
            Block::InboxHeader => self.inbox_header.to_vec(),
            Block::InboxPage => self.inbox_page.to_vec(),
            Block::InboxState => self.inbox.image(order),
            Block::OutboxHeader => self.handshake.outbox().map_or_else(|| vec![0; 56], |outbox| outbox.header_image()),
            Block::OutboxSelect => self.select.to_vec(),
            Block::OutboxPage => {
                let page = order.to_u32(self.select);
                let outbox = self.handshake.outbox();
                outbox.map_or_else(|| page_image(order, page, &[]), |outbox| outbox.page_image(order, page))
            }
        }
    }

    fn identity_image(&self) -> Vec<u16> {
        let name: Vec<u8> = self.handshake.body.name().bytes().filter(u8::is_ascii).take(32).collect();
        RegisterBlock::new(self.options.word_order, 32)
            .u16(0, 0x5247)
            .u16(1, 0x4431)
            .u16(2, self.options.version)
            .u16(3, self.kind() as u16)
            .u32(4, 0x1234_5678)
            .f64(6, -2.5e-7)
            .u32(10, self.handshake.boot_id)
            .u16(12, 1 | u16::from(self.handshake.gives_ahead()) << 1)
            .u16(13, 1)
            .u16(15, self.options.lost_after_ms)
            .bytes(16, &name)
            .done()
    }

    fn status_image(&mut self) -> Vec<u16> {
        let mut image = self.status.clone();
        if std::mem::take(&mut self.torn) {
            image[47] = image[47].wrapping_sub(1);
        }
        image
    }

    /// Copies the present state of the machine into the registers of the status block. If a register changes, the
    /// snapshot number of the block increases by 1. Does nothing while the application is frozen.
    fn publish(&mut self) {
        if self.frozen {
            return;
        }
        let mut image = self.handshake.image();
        (image[28], image[29]) = (self.machine_beat, self.beat_echo);
        if image[1..47] != self.status[1..47] {
            let number = self.status[0].wrapping_add(1);
            (image[0], image[47]) = (number, number);
            self.status = image;
        }
    }

    /// Returns the kind of machine.
    pub fn kind(&self) -> Kind {
        self.handshake.body.kind()
    }

    /// Returns the state of the machine. While the application is frozen, this state can differ from the state in the
    /// status registers.
    pub fn state(&self) -> State {
        self.handshake.state
    }

    /// Returns the boot id of the identity block.
    pub fn boot_id(&self) -> u32 {
        self.handshake.boot_id
    }

    /// Returns the name and serial number of the machine.
    pub fn name(&self) -> String {
        self.handshake.body.name()
    }

    /// Returns the addresses of the register blocks of the machine.
    pub fn layout(&self) -> &RegisterLayout {
        &self.options.layout
    }

    /// Returns the events in the log, the oldest first. When the log is full, the older half of the events is removed;
    /// [`Self::forgotten`] counts the removed events.
    pub fn log(&self) -> &[LogEntry] {
        self.handshake.log.entries()
    }

    /// Sets an observer, which receives all events of the machine from now on.
    pub fn set_observer(&mut self, observer: Observer) {
        self.handshake.log.set_observer(observer);
    }

    /// Returns the number of old events that were removed from the log.
    pub fn forgotten(&self) -> u64 {
        self.handshake.log.forgotten()
    }

    /// Returns one entry for each job that began, the oldest first: the sequence number of the START command, the
    /// number of the job, and the number of the cycle. Jobs whose events were removed from the log are missing.
    pub fn began(&self) -> Vec<(u32, u32, u16)> {
        let began = |seen: &LogEntry| match seen.event {
            HandshakeEvent::Began { start, job, cycle } => Some((start, job, cycle)),
            _ => None,
        };
        self.log().iter().filter_map(began).collect()
    }

    /// Sets the number of simulated seconds in a real second.
    pub fn set_speed(&mut self, speed: f64) {
        self.handshake.speed = speed.max(0.0);
    }

    /// Freezes the application of the machine if `frozen` is true, and lets it continue if `frozen` is false. A frozen
    /// machine still answers Modbus requests, but its status registers do not change. The last command that is written
    /// during this time is carried out only after the application continues.
    pub fn freeze(&mut self, frozen: bool) {
        self.frozen = frozen;
        self.publish();
    }

    /// Restarts the program of the machine, with another boot id. The program loses its memory, except the list of the
    /// jobs that began. If the restart interrupts a job, the machine reports fault 30.
    pub fn reboot(&mut self) {
        self.handshake.reboot();
        self.empty_memory();
    }

    /// Simulates a restart of the machine's program that is not allowed on a real machine. The boot id stays the same,
    /// the list of the jobs that began is lost, and the machine reports no fault. After the restart, the machine is
    /// idle.
    pub fn forget(&mut self) {
        self.handshake.forget();
        self.empty_memory();
    }

    fn empty_memory(&mut self) {
        self.inbox = Inbox::default();
        (self.sync, self.beat, self.command, self.select) = ([0; 2], 0, [0; 20], [0; 2]);
        self.beat_block = [0; 3];
        (self.inbox_header, self.inbox_page) = ([0; 24], [0; 120]);
        (self.machine_beat, self.beat_echo, self.frozen, self.unseen) = (0, 0, false, false);
        self.publish();
    }

    /// Turns the key switch at the machine's panel to `mode`.
    pub fn set_mode(&mut self, mode: Mode) {
        self.handshake.turn_key(mode);
        self.publish();
    }

    /// Opens the interlocks whose bits are set in `bits`, even if the simulated physics reports them closed. The bits
    /// are listed in [`crate::command::interlock`]. Each call replaces the bits of the previous call. With `bits` = 0,
    /// all interlocks follow the physics again.
    pub fn open_interlocks(&mut self, bits: u16) {
        self.handshake.open(bits);
        self.publish();
    }

    /// Presses the button at the machine's panel that continues a held job.
    pub fn press_start(&mut self) {
        self.handshake.press_start();
        self.publish();
    }

    /// Simulates a motion without a command. If `strays` is true, an idle machine begins to move. If `strays` is false,
    /// such a motion ends and the machine is idle again. Does nothing in any other case.
    pub fn stray(&mut self, strays: bool) {
        self.handshake.stray(strays);
        self.publish();
    }

    /// Requests a fault that happens once: the machine changes the identities of all payloads in force (the payloads
    /// that the machine uses at present). The fault happens after two events: a new payload comes into force, and then
    /// a client reads the registers that list the payloads in force.
    pub fn spoil(&mut self) {
        self.handshake.spoil();
    }

    /// Stops the machine with the fault number `fault` of docs/modbus.md. The machine moves clear of the part and
    /// enters FAULTED. A running job ends with the result failed.
    pub fn fail(&mut self, fault: u16) {
        self.handshake.fail(fault);
        self.publish();
    }

    /// Makes the next read of the status block inconsistent. The snapshot numbers in the first and in the last register
    /// of the block then differ, as if the registers were from two different moments. Later reads are correct again.
    pub fn tear_status(&mut self) {
        self.torn = true;
    }
}

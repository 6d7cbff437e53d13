#!/usr/bin/env python3
"""Takes away one guard of the control side after the other, and counts the schedules until one breaks a promise.

    tests/schedules/guards.py [--most N] [NAME ...]

Each guard is a place in the sources and what stands there without it. The change is made in a copy of the tree, below target/guards,
which is built anew for each: about a minute apiece. Where another guard stands behind it in a whole run, a test of its room is named
that sees it. What neither sees within N schedules is told as not seen.
"""
import argparse, re, shutil, subprocess, sys
from pathlib import Path

# From this seed on schedules are by other wires than Modbus.
OTHER_WIRES = 1_000_000
# Schedules that take longer hang: 2,000 take some 500 s on two cores.
MAX_SECONDS = 3600

GUARDS = {
    "START waits for its record": (
        "src/drive/record_queue.rs", "        Command::HoldMachine { .. }\n", "        Command::StartMachine { .. } | Command::HoldMachine { .. }\n"),
    "what has waited is asked of the cell once more": (
        "src/drive/recording.rs", "RecordAction::Execute(command) if self.cell.still_requires(&command) =>", "RecordAction::Execute(command) if true || self.cell.still_requires(&command) =>"),
    "an order is answered when it is on record": (
        "src/drive/orders.rs", "self.record.queue(ticket, RecordAction::Answer { answer, accepted, message });",
        "drop((ticket, answer.send(Reply::new(accepted, message, self.snapshot()))));"),
    "an abort gives up what the machine is asked": (
        "src/drive/station.rs", "() = aborts.wait_for_abort() => {}\n                        () = self.handle_request(ask)", "() = std::future::pending() => {}\n                        () = self.handle_request(ask)"),
    "an abort waits for no record": (
        "src/drive/record_queue.rs", "            | Command::AbortMachine { .. }\n            | Command::VerifyClear", "            | Command::VerifyClear"),
    "a START without an answer is unknown": (
        "src/drive/station/commands.rs", "self.report(Event::StartUnknown { device: B::DEVICE, cycle, reason: error.to_string() }).await;",
        "self.observed.running = false; self.report_failure(MachineRequest::Start, error).await;"),
    "a START that was not seen is fenced off": (
        "src/device/modbus/commands.rs", "        self.claim().await?;\n        let second", "        let second",
        "device", "late_start_after_reconcile_is_fenced"),
    "a machine that was lost is sent no START": (
        "src/drive/station/commands.rs", "        if self.observed.link_lost {\n            return self.refuse_unsent(MachineRequest::Start).await;\n        }\n", ""),
    "a machine that was lost is sent no RESUME": (
        "src/drive/station/commands.rs", "        if self.observed.link_lost {\n            return self.refuse_unsent(MachineRequest::Resume).await;\n        }\n", ""),
    "a station looks again after the loop has hung": (
        "src/drive/station.rs", "if self.observed.connected => if pulse.is_alive() {", "if self.observed.connected && pulse.is_alive() => if true {",
        "schedules", "suspended_computer_continues"),
    "holding goes on when the link is lost": (
        "src/cell/connections.rs", "        if is_holding && phase.moving_device() == Some(device) {\n", "        if is_holding && phase.moving_device() == Some(device) {\n            self.enter_state(Held(phase_after_link_loss(phase)));\n        } else if false {\n"),
    "a question that is not on record makes the machine hold": (
        "src/cell/interruptions.rs", "                self.push(Command::HoldMachine { device });\n            }\n            _ => self.enter_state(Held(restart_phase(phase))),", "            }\n            _ => self.enter_state(Held(restart_phase(phase))),",
        "cell", "unrecorded_reconcile_never_shows_held"),
    "a job found running while holding is told to hold": (
        "src/cell/machine_job.rs", "                self.enter_state(self.state_with_phase(run));\n                self.push(Command::HoldMachine { device });\n", "                self.enter_state(self.state_with_phase(run));\n"),
    "a machine that moves while the cell stands is told to hold": (
        "src/cell/interruptions.rs", "        let astray = self.machine(device).moves_unordered;\n", "        return;\n        #[allow(unreachable_code)]\n        let astray = false;\n",
        "cell", "motion_while_held_commands_hold"),
    "a program that was started again asks what became of the job": (
        "src/cell/connections.rs", "        self.enter_state(Held(phase_after_link_loss(phase)));\n        for device in Device::BOTH {", "        self.enter_state(Held(restart_phase(phase)));\n        for device in Device::BOTH {"),
    "an answer of an older connection is turned away": (
        "src/device/modbus/link.rs", "        if stale {\n", "        if stale && false {\n"),
    "nothing may wait when a request begins": (
        "src/device/modbus/link.rs", "if self.inner.waiting_bytes(cx)? > 0 {", "if self.inner.waiting_bytes(cx)? > usize::MAX - 1 {"),
    "an answer has as many registers as were asked": (
        "src/device/modbus/link.rs", "if words.len() == usize::from(*count) =>", "if !words.is_empty() =>"),
    "a connection is given up after an error": (
        "src/device/modbus/link.rs", "        if !matches!(fault, LinkFault::Exception(_)) {\n            self.drop_connection();", "        if false {\n            self.drop_connection();"),
    "payloads in force are compared before a job": (
        "src/device/modbus/commands.rs", "            self.compare_slot(kind).await?;\n", "            let _ = kind;\n"),
    "what was seen to begin has begun, whatever the machine says": (
        "src/cell/machine_job.rs", "(Reconciliation::NotStarted, _) if self.job_observed[device as usize] => {", "(Reconciliation::NotStarted, _) if self.job_observed[device as usize] && false => {"),
    "what has not come on record is withdrawn while the disk is full": (
        "src/drive/recording.rs", "        if self.record.failure_reason.is_none() || self.ending.is_some() {\n", "        if true {\n"),
    "an abort of a lost I++ connection is given anew": (
        "src/device/ippdme/machine.rs", "saturating_sub(u64::from(state == MachineState::Aborting))", "saturating_sub(u64::from(state == MachineState::Aborting && false))",
        "device", "abort_is_first_after_reconnect"),
    "what an interrupted I++ job has left moving is aborted": (
        "src/device/ippdme/machine.rs", "moved.then_some(self.settings.silence_limit)", "moved.then_some(self.settings.silence_limit).filter(|_| false)"),
    "a line of another I++ command is none of this one": (
        "src/device/ippdme/link.rs", "if response.tag == pending.tag {", "if response.tag == pending.tag || matches!(response.tag, Tag::Command(_)) {",
        "device", "unrequested_data_disconnects"),
    "an I++ job is held between two targets": (
        "src/device/ippdme/job.rs", "if self.current_request().is_some() {\n                    break 'job;", "if false && self.current_request().is_some() {\n                    break 'job;",
        "device", "hold_retracts_resume_touches_rest"),
    "an I++ job is held between two rows": (
        "src/device/ippdme/job.rs", "if self.current_request().is_some() {\n                    break;", "if false && self.current_request().is_some() {\n                    break;",
        "device", "hold_in_scan_defers_next_row"),
    "the probe travels at the clearance": (
        "src/device/ippdme/job.rs", "        self.rise(work).await?;\n        let [x, y, z]", "        let [x, y, z]"),
    "a program that has begun is not prepared again": (
        "src/device/linuxcnc/machine/start.rs", "if before.begun > 0 {", "if false && before.begun > 0 {",
        "linuxcnc", "prepare_refuses_begun_program"),
    "the controller has the program that it was told to open": (
        "src/device/linuxcnc/controller.rs", "|seen| seen.program.as_deref() == Some(path) && seen.line == 0)", "|_| true)",
        "linuxcnc", "ignored_open_fails_load"),
    "a lost linuxcncrsh is told as lost": (
        "src/device/linuxcnc/controller.rs", "self.link_error.clone().unwrap_or_else(never)", "self.link_error.clone().filter(|_| false).unwrap_or_else(never)"),
    "a program writes its end behind its motion": (
        "src/device/linuxcnc/program.rs", "{again}M66 P0 L0\\n{}M2", "{again}{}M2"),
    "a START of LinuxCNC that was not seen is fenced off": (
        "src/device/linuxcnc/machine/reconcile.rs", "        self.take_control().await?;\n        let fenced", "        let fenced",
        "linuxcnc", "ignored_start_unknown_until_reconcile"),
    "what is prepared is looked at before a START": (
        "src/device/linuxcnc/machine.rs", "if !is_prepared || status.state != MachineState::Prepared || seen.mode", "if seen.mode",
        "linuxcnc", "start_refuses_replaced_program"),
}  # fmt: skip

# Guards that schedules of a kind of their own are about.
KINDS = {
    "what was seen to begin has begun, whatever the machine says": "schedules_with_forgotten_job",
    "what has not come on record is withdrawn while the disk is full": "schedules_with_full_disk",
}


def main():
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("names", nargs="*", metavar="NAME", help="guards whose name has this in it; all if none is given")
    options.add_argument("--most", type=int, default=2000, help="schedules to try at most (2000)")
    options.add_argument("--target", type=Path, help="folder for what is built, if not target/guards/target")
    given = options.parse_args()
    root = Path(__file__).resolve().parents[2]
    tree = root / "target/guards/tree"
    target = given.target or root / "target/guards/target"
    unseen = 0
    for name, change in GUARDS.items():
        if given.names and not any(wanted in name for wanted in given.names):
            continue
        try:
            seeds, first = tried(root, tree, target, change, KINDS.get(name), given.most)
        except NotBuilt as error:
            # The others are counted all the same.
            unseen += 1
            print(f"| {name} | not built without it | {error} |", flush=True)
            continue
        unseen += first is None
        found = f"{seeds} | {first}" if first else f"not seen in {seeds} |"
        print(f"| {name} | {found} |", flush=True)
    sys.exit(1 if unseen else 0)


class NotBuilt(Exception):
    """The tree without the guard does not compile."""


def tried(root, tree, target, change, kind, most):
    """Returns how many schedules were tried, and what the first to break a promise says."""
    file, guard, without, *by_test = change
    shutil.rmtree(tree, ignore_errors=True)
    shutil.copytree(root, tree, ignore=shutil.ignore_patterns("target", ".git"))
    text = (tree / file).read_text()
    if guard not in text:
        sys.exit(f"{file} has no longer {guard!r}: see where that guard is now")
    # What the guard before has changed is as it was, and older than what was built of it.
    before = target / "changed"
    if before.is_file():
        (tree / before.read_text()).touch()
    target.mkdir(parents=True, exist_ok=True)
    before.write_text(file)
    # The first place, which is the one that is told of.
    (tree / file).write_text(text.replace(guard, without, 1))
    build = ["cargo", "test", "--workspace", "--test", "schedules", "--no-run", "--target-dir", target]
    built = subprocess.run(build, cwd=tree, capture_output=True, text=True)
    if built.returncode:
        raise NotBuilt(re.search(r"^error.*$", built.stderr, re.M)[0])
    program = re.findall(r"\((\S*schedules-\w+)\)", built.stderr)[-1]
    seeds = min(25, most)
    while True:
        environment = {"REGRIND_SCHEDULES": str(seeds), "PATH": "/usr/bin:/bin"}
        other = "ippdme" in file or "linuxcnc" in file
        run = ["--exact", kind or ("schedules_on_other_wires" if other else "schedules_keep_promises")]
        try:
            done = subprocess.run([tree / program, *run], cwd=tree, env=environment, capture_output=True, text=True, timeout=MAX_SECONDS)
        except subprocess.TimeoutExpired:
            return seeds, f"one of them did not end within {MAX_SECONDS} s"
        broken = re.findall(r"^seed (\d+): (.*)$", done.stdout + done.stderr, re.M)
        if broken:
            seed, what = min(broken, key=lambda found: int(found[0]))
            return int(seed) % OTHER_WIRES + 1, f"seed {seed}: {what}"
        if seeds >= most:
            return seeds, by_test[1] if by_test and fails(tree, target, *by_test) else None
        seeds = min(4 * seeds, most)


def fails(tree, target, room, test):
    """Tells whether a test of a room fails."""
    run = ["cargo", "test", "--workspace", "--test", room, "--target-dir", target, test]
    return "FAILED" in subprocess.run(run, cwd=tree, capture_output=True, text=True).stdout


if __name__ == "__main__":
    main()

//! Check of the network address of a machine in a cell file.

use std::net::IpAddr;

use regrind_document::Document;

use crate::machine_table::MachineTable;

/// Texts of the message about a host that is not only a name or an address.
pub(crate) struct HostTexts {
    /// Statement of what a host may be.
    pub allowed: &'static str,
    /// Remedy for a host that contains more, such as a port.
    pub remedy: &'static str,
}

/// Reports problems of the keys `host` and `port` to `document`: a host that is not only a name or an address, a
/// simulated machine on another computer, and the port 0 in a cell that is not simulated. `usual_port` is the remedy for
/// the port.
pub(crate) fn check_address(
    (host, port): (&str, u16),
    (texts, usual_port): (&HostTexts, &str),
    place: &MachineTable<'_>,
    document: &mut Document,
) {
    let is_fine = check_host(host, texts, place, document);
    // The schema reports an empty host.
    if is_fine && !host.is_empty() && place.simulated == Some(true) && !is_this_computer(host) {
        document.report(
            &place.key("wire.host"),
            format!("is {host:?} in a simulated cell"),
            "a simulated machine must be on this computer: 127.0.0.1, ::1 or localhost",
            "if the machine is real, write `simulated = false`",
        );
    }
    if port == 0 && place.simulated == Some(false) {
        let found = "is 0 in a cell that is not simulated";
        let allowed = "the port must be a whole number from 1 to 65535";
        document.report(&place.key("wire.port"), found, allowed, usual_port);
    }
}

/// Reports a host that is not only a name or an address to `document`. Returns true if there is no problem.
pub(crate) fn check_host(host: &str, texts: &HostTexts, place: &MachineTable<'_>, document: &mut Document) -> bool {
    let is_fine = !host.chars().any(|c| c.is_whitespace() || c == '/' || c == '@');
    if !is_fine {
        document.report(&place.key("wire.host"), format!("is {host:?}"), texts.allowed, texts.remedy);
    }
    is_fine
}

/// Returns true if `host` is this computer by its name or address.
pub(crate) fn is_this_computer(host: &str) -> bool {
    host == "localhost" || host.parse::<IpAddr>().is_ok_and(|address| address.is_loopback())
}

//! Runs tests in their own namespaces: their mounts, locks and ports are not visible outside.

use std::path::Path;
use std::process::Command;

use crate::program::root;

/// Variable that is set for the test that runs inside.
const WITHIN: &str = "REGRIND_WITHIN_NAMESPACES";

/// Command that runs a program under an account other than root.
pub const ACCOUNT: [&str; 4] = ["setpriv", "--reuid=65534", "--regid=65534", "--clear-groups"];

/// Runs a test with an empty folder for each kind of temporary files, and its own network. `name` is the path of the
/// test in this program. Needs root.
pub fn in_namespaces(name: &str, test: impl FnOnce(&Path)) {
    if std::env::var_os(WITHIN).is_some() {
        let home = tempfile::tempdir().unwrap();
        return test(home.path());
    }
    // Locks of machines are kept outside /tmp too. The program under test may itself be in one of these folders.
    let prepare = "needed=\"$1 $2\"; shift 2
    for folder in /tmp /run/lock /var/lock /var/tmp; do
        [ -d $folder ] || continue
        mount --bind $folder /mnt
        mount -t tmpfs tmpfs $folder; chmod 1777 $folder
        for path in $needed; do
            case $path in $folder/*) mkdir -p $path; mount --bind /mnt/${path#$folder/} $path ;; esac
        done
        umount /mnt
    done
    ip link set lo up; exec \"$@\"";
    let program = std::env::current_exe().unwrap();
    let built = program.parent().and_then(Path::parent).unwrap();
    let mut command = Command::new("unshare");
    command.args(["--ipc", "--net", "--pid", "--mount", "--fork", "--mount-proc", "--kill-child"]);
    command.args(["sh", "-euc", prepare, "sh"]).arg(root()).arg(built).arg(&program);
    command.args(["--exact", name, "--include-ignored", "--nocapture"]);
    command.env(WITHIN, "1").env_remove("TMPDIR").env_remove("DISPLAY");
    let output = command.output().expect("unshare starts");
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    let (told, errors) = (text(&output.stdout), text(&output.stderr));
    assert!(output.status.success() && told.contains("1 passed"), "{told}\n{errors}");
    println!("{told}");
}

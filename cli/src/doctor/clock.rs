//! Checks the wall clock: nodes do not compare their wall clocks, but a node's incarnation number comes from it, and it
//! orders the logs of several hosts.

use std::{
    process::{Command, Stdio},
    sync::mpsc::sync_channel,
    time::Duration,
};

use rustix::time::{ClockId, clock_gettime};

use super::Check;

/// 2020-01-01, in seconds since 1970: a clock before that was never set.
const NEVER_SET: i64 = 1_577_836_800;
/// Time limit for the answer of the time service.
const ANSWERED_WITHIN: Duration = Duration::from_secs(1);

/// Checks the clock.
pub(super) fn clock() -> Check {
    judged(clock_gettime(ClockId::Realtime).tv_sec, is_synchronised())
}

fn judged(now_s: i64, is_synchronised: Option<bool>) -> Check {
    const NAME: &str = "clock";
    if now_s < NEVER_SET {
        return Check::finding(
            NAME,
            "the wall clock stands before 2020: a board without a battery, or never set. A node that is restarted may count as a former incarnation of \
             itself, and is refused"
                .to_owned(),
            "sudo timedatectl set-ntp true, or sudo date -s '2026-01-31 12:00' before the nodes start",
        );
    }
    match is_synchronised {
        Some(true) => Check::fine(NAME, "the kernel's clock is synchronised".to_owned()),
        Some(false) => Check::finding(
            NAME,
            "the kernel's clock is not synchronised: messages keep their ages (nodes measure each other), logs of several hosts do not fit together"
                .to_owned(),
            "sudo timedatectl set-ntp true; or sudo apt-get install chrony",
        ),
        None => Check::fine(
            NAME,
            "it is set; whether it is synchronised is not known here (timedatectl). Messages' ages do not depend on it".to_owned(),
        ),
    }
}

/// Returns the state that systemd's service reads from the kernel (`adjtimex`); `None` if the service is missing or
/// does not answer.
fn is_synchronised() -> Option<bool> {
    let (sender, receiver) = sync_channel(1);
    std::thread::spawn(move || {
        let mut command = Command::new("timedatectl");
        command
            .args(["show", "--property=NTPSynchronized", "--value"])
            .stdin(Stdio::null())
            .stderr(Stdio::null());
        // The receiver has been dropped if this was too slow.
        let _ = sender.send(command.output().ok().filter(|output| output.status.success()));
    });
    let output = receiver.recv_timeout(ANSWERED_WITHIN).ok()??;
    match String::from_utf8(output.stdout).ok()?.trim() {
        "yes" => Some(true),
        "no" => Some(false),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unset_or_unsynchronised_clock_is_a_finding() {
        assert!(judged(1_000, Some(true)).fix.is_some_and(|fix| fix.contains("date -s")));
        assert!(judged(NEVER_SET, Some(false)).fix.is_some());
        assert!(judged(NEVER_SET, Some(true)).fix.is_none() && judged(NEVER_SET, None).fix.is_none());
    }
}

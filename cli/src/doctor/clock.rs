//! The wall clock: nodes compare none with another, but a node's life is numbered by it, and logs of several hosts are put side by side.

use std::{
    process::{Command, Stdio},
    sync::mpsc::sync_channel,
    time::Duration,
};

use rustix::time::{ClockId, clock_gettime};

use super::Check;

/// 2020-01-01, in seconds since 1970: a clock before that was never set.
const NEVER_SET: i64 = 1_577_836_800;
/// Time for the answer of the service that keeps the clock.
const ANSWERED_WITHIN: Duration = Duration::from_secs(1);

/// What is so.
pub(super) fn clock() -> Check {
    judged(clock_gettime(ClockId::Realtime).tv_sec, is_synchronised())
}

fn judged(now_s: i64, is_synchronised: Option<bool>) -> Check {
    const NAME: &str = "clock";
    if now_s < NEVER_SET {
        return Check::finding(
            NAME,
            "the wall clock stands before 2020: a board without a battery, or never set. A node that is restarted may count as a former life of \
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
            "it is set; nobody here says whether it is synchronised (timedatectl). Messages' ages do not depend on it".to_owned(),
        ),
    }
}

/// What systemd's service reads from the kernel (`adjtimex`); `None` where it is not, or does not answer.
fn is_synchronised() -> Option<bool> {
    let (say, said) = sync_channel(1);
    std::thread::spawn(move || {
        let mut command = Command::new("timedatectl");
        command
            .args(["show", "--property=NTPSynchronized", "--value"])
            .stdin(Stdio::null())
            .stderr(Stdio::null());
        // Nobody listens any more when it was too slow.
        let _ = say.send(command.output().ok().filter(|output| output.status.success()));
    });
    let output = said.recv_timeout(ANSWERED_WITHIN).ok()??;
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
    fn a_clock_that_was_never_set_or_runs_free_is_a_finding_and_one_that_nobody_judges_is_not() {
        assert!(judged(1_000, Some(true)).mend.is_some_and(|mend| mend.contains("date -s")));
        assert!(judged(NEVER_SET, Some(false)).mend.is_some());
        assert!(judged(NEVER_SET, Some(true)).mend.is_none() && judged(NEVER_SET, None).mend.is_none());
    }
}

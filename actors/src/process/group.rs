//! A process that this node has started, and what that has started in its turn: ended together.

use std::{
    os::fd::{AsFd, OwnedFd},
    sync::{Arc, Mutex},
};

use rustix::process::{
    Pid, Signal, WaitId, WaitIdOptions, WaitIdStatus, kill_process_group, pidfd_send_signal, waitid,
};

use crate::stores::lock;

/// The process leads a group, which has its number. What it starts is in that group until it leaves it.
pub(super) struct Group {
    leader: Pid,
    pidfd: Arc<OwnedFd>,
    /// Whether the number is surely the leader's: nobody else has it until the leader is reaped.
    is_numbered: Mutex<bool>,
}

impl Group {
    /// The group of this child of ours, which nobody has waited for, and its descriptor.
    pub(super) fn new(leader: Pid, pidfd: OwnedFd) -> Self {
        Self { leader, pidfd: Arc::new(pidfd), is_numbered: Mutex::new(true) }
    }

    pub(super) fn leader(&self) -> Pid {
        self.leader
    }

    /// What tells of the leader's end.
    pub(super) fn pidfd(&self) -> &Arc<OwnedFd> {
        &self.pidfd
    }

    /// Kills the leader, if it lives, and all that is in its group.
    pub(super) fn kill(&self) {
        // Errors say that there is nobody left.
        let _ = pidfd_send_signal(&self.pidfd, Signal::KILL);
        let is_numbered = lock(&self.is_numbered);
        // The second: it is not our child any more where the program ignores SIGCHLD.
        if *is_numbered && self.ending().is_ok() {
            let _ = kill_process_group(self.leader, Signal::KILL);
        }
    }

    /// How the leader has ended; `None` if it has not. It is left to be reaped. An error says that it cannot be known.
    pub(super) fn ending(&self) -> rustix::io::Result<Option<WaitIdStatus>> {
        self.wait(WaitIdOptions::NOWAIT)
    }

    /// Reaps the leader, if it has ended, and kills what is left of its group before that. Returns whether all is done. The
    /// kernel may take its time.
    pub(super) fn has_been_reaped(&self) -> bool {
        match self.ending() {
            Ok(None) => return false,
            Ok(Some(_)) => self.kill(),
            // It is nobody's child any more.
            Err(_) => {}
        }
        *lock(&self.is_numbered) = false;
        !matches!(self.wait(WaitIdOptions::empty()), Ok(None))
    }

    fn wait(&self, how: WaitIdOptions) -> rustix::io::Result<Option<WaitIdStatus>> {
        waitid(WaitId::PidFd(self.pidfd.as_fd()), WaitIdOptions::EXITED | WaitIdOptions::NOHANG | how)
    }
}

#[cfg(test)]
mod tests {
    use std::{
        io::Read,
        os::unix::process::CommandExt,
        process::{ChildStdout, Command, Stdio},
    };

    use rustix::{
        event::{PollFd, PollFlags, Timespec, poll},
        process::{PidfdFlags, pidfd_open},
    };

    use super::*;

    /// A shell that runs this in a group of its own, and what it and all that it starts have for their output.
    #[expect(clippy::zombie_processes, reason = "reaping it is what is tried")]
    fn shell(script: &str) -> (Group, ChildStdout) {
        let mut command = Command::new("sh");
        command.args(["-c", script]).process_group(0).stdout(Stdio::piped());
        let mut child = command.spawn().expect("a program that every system has");
        let leader = Pid::from_child(&child);
        let pidfd = pidfd_open(leader, PidfdFlags::empty()).expect("it is a child of ours");
        (Group::new(leader, pidfd), child.stdout.take().expect("it is a pipe"))
    }

    fn wait_for_end(group: &Group) {
        poll(&mut [PollFd::new(group.pidfd(), PollFlags::IN)], None).expect("it ends");
    }

    /// Waits until all that have this for their output have ended, much less long than anybody sleeps here.
    fn wait_until_all_have_ended(output: &ChildStdout) {
        let deadline = Timespec { tv_sec: 30, tv_nsec: 0 };
        let mut polled = [PollFd::new(output, PollFlags::empty())];
        assert_eq!(poll(&mut polled, Some(&deadline)), Ok(1), "what the process has started lives on");
    }

    #[test]
    fn who_looks_how_a_process_has_ended_leaves_it_to_be_reaped() {
        let (group, _) = shell("exit 3");
        wait_for_end(&group);
        for _ in 0..2 {
            let status = group.ending().expect("it is not reaped yet").expect("it has ended");
            assert_eq!(status.exit_status(), Some(3));
        }
        assert!(group.has_been_reaped());
        assert!(group.ending().is_err(), "there is nothing left of it");
        assert!(!*lock(&group.is_numbered), "its number may be anybody's");
    }

    #[test]
    fn what_a_process_has_started_is_killed_before_that_is_reaped() {
        let (group, output) = shell("sleep 100 & exit 0");
        wait_for_end(&group);
        assert!(group.has_been_reaped());
        wait_until_all_have_ended(&output);
    }

    #[test]
    fn a_process_that_has_not_ended_is_not_reaped_and_is_killed_with_all_that_it_has_started() {
        let (group, mut output) = shell("sleep 100 & echo; sleep 100");
        assert_eq!(output.read(&mut [0]).expect("it can be read"), 1, "the first one has been started");
        assert!(!group.has_been_reaped());
        group.kill();
        wait_for_end(&group);
        wait_until_all_have_ended(&output);
        assert!(group.has_been_reaped());
    }
}

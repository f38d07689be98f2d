//! The process group of a child: the process, and all that it starts, end together.

use std::{
    os::fd::{AsFd, OwnedFd},
    sync::{Arc, Mutex},
};

use rustix::process::{
    Pid, Signal, WaitId, WaitIdOptions, WaitIdStatus, kill_process_group, pidfd_send_signal, waitid,
};

use sinew_runtime::lock;

/// The child leads a group with its own number. Processes that it starts are in the group until they leave it.
pub(super) struct Group {
    leader: Pid,
    pidfd: Arc<OwnedFd>,
    /// Whether the number still belongs to the leader. The kernel does not reuse it before the leader is reaped.
    is_numbered: Mutex<bool>,
}

impl Group {
    /// Creates the group of an unreaped child of this process, with its pidfd.
    pub(super) fn new(leader: Pid, pidfd: OwnedFd) -> Self {
        Self { leader, pidfd: Arc::new(pidfd), is_numbered: Mutex::new(true) }
    }

    pub(super) fn leader(&self) -> Pid {
        self.leader
    }

    /// Returns the descriptor that signals the leader's end.
    pub(super) fn pidfd(&self) -> &Arc<OwnedFd> {
        &self.pidfd
    }

    /// Asks the leader and all processes of its group to end (SIGTERM).
    pub(super) fn terminate(&self) {
        let is_numbered = lock(&self.is_numbered);
        let is_led = *is_numbered && self.ending().is_ok();
        if !is_led || kill_process_group(self.leader, Signal::TERM).is_err() {
            // The leader has no group yet, or has ended. An error means that no process is left.
            let _ = pidfd_send_signal(&self.pidfd, Signal::TERM);
        }
    }

    /// Kills the leader, if it lives, and all processes of its group.
    pub(super) fn kill(&self) {
        // An error means that no process is left.
        let _ = pidfd_send_signal(&self.pidfd, Signal::KILL);
        let is_numbered = lock(&self.is_numbered);
        // The second check: the leader is not our child any more if the program ignores SIGCHLD.
        if *is_numbered && self.ending().is_ok() {
            let _ = kill_process_group(self.leader, Signal::KILL);
        }
    }

    /// Returns the leader's exit status, or `None` if it still runs. The leader is not reaped. An error means that the
    /// status is unknown.
    pub(super) fn ending(&self) -> rustix::io::Result<Option<WaitIdStatus>> {
        self.wait(WaitIdOptions::NOWAIT)
    }

    /// Reaps the leader if it has ended, after killing the rest of its group. Returns whether all is done. The kernel
    /// may need time for that.
    pub(super) fn has_been_reaped(&self) -> bool {
        match self.ending() {
            Ok(None) => return false,
            Ok(Some(_)) => self.kill(),
            // It is no longer a child of this process.
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

    /// Starts a shell that runs `script` in its own process group. Returns the group, and the shared output
    /// of the shell and its descendants.
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

    /// Waits until all processes with this output have ended, for much less time than any of them sleeps.
    fn wait_until_all_have_ended(output: &ChildStdout) {
        let deadline = Timespec { tv_sec: 30, tv_nsec: 0 };
        let mut polled = [PollFd::new(output, PollFlags::empty())];
        assert_eq!(poll(&mut polled, Some(&deadline)), Ok(1), "what the process has started lives on");
    }

    #[test]
    fn reading_exit_status_does_not_reap() {
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
    fn descendants_are_killed_before_the_leader_is_reaped() {
        let (group, output) = shell("sleep 100 & exit 0");
        wait_for_end(&group);
        assert!(group.has_been_reaped());
        wait_until_all_have_ended(&output);
    }

    #[test]
    fn running_process_is_killed_with_its_descendants() {
        let (group, mut output) = shell("sleep 100 & echo; sleep 100");
        assert_eq!(output.read(&mut [0]).expect("it can be read"), 1, "the first one has been started");
        assert!(!group.has_been_reaped());
        group.kill();
        wait_for_end(&group);
        wait_until_all_have_ended(&output);
        assert!(group.has_been_reaped());
    }
}

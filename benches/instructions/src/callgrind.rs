//! Processes under callgrind, and the instructions that they have executed.

use std::{
    fs,
    path::{Path, PathBuf},
    process::Command,
};

use sinew_figures::process::{self, Process};

/// The processes of one run of a path. Each writes its count at its end.
pub(crate) struct Counted {
    directory: PathBuf,
    is_kept: bool,
    started: u32,
}

impl Counted {
    /// Creates the directory for a run. With `kept`, callgrind's files stay there.
    pub(crate) fn new(kept: Option<PathBuf>) -> Result<Self, String> {
        let is_kept = kept.is_some();
        let temporary = || std::env::temp_dir().join(format!("sinew-instructions-{}", std::process::id()));
        let directory = kept.unwrap_or_else(temporary);
        fs::create_dir_all(&directory).map_err(|why| format!("{}: {why}", directory.display()))?;
        Ok(Self { directory, is_kept, started: 0 })
    }

    /// A directory for sockets.
    pub(crate) fn directory(&self) -> &Path {
        &self.directory
    }

    /// Starts this program in another role, and waits until it is ready.
    pub(crate) fn start(&mut self, role: &str) -> Process {
        Process::start_command(self.command(role), role)
    }

    /// Runs this program in another role until it ends.
    pub(crate) fn run(&mut self, role: &str) -> Result<(), String> {
        let has_run = process::has_run(self.command(role));
        has_run
            .then_some(())
            .ok_or_else(|| format!("the process with the role `{role}` failed under valgrind"))
    }

    fn command(&mut self, role: &str) -> Command {
        self.started += 1;
        let plain = process::command(role);
        let mut command = Command::new("valgrind");
        // Threads run in the order in which they became ready.
        command.args(["--quiet", "--tool=callgrind", "--fair-sched=yes"]);
        command.arg(format!(
            "--callgrind-out-file={}",
            self.directory.join(format!("{}.out", self.started)).display()
        ));
        command.arg(plain.get_program());
        for (name, value) in plain.get_envs() {
            match value {
                Some(value) => command.env(name, value),
                None => command.env_remove(name),
            };
        }
        command
    }

    /// The instructions of all processes, which have ended.
    pub(crate) fn total(self) -> Result<u64, String> {
        let count = |number: u32| {
            let path = self.directory.join(format!("{number}.out"));
            let text = fs::read_to_string(&path)
                .map_err(|why| format!("callgrind left no {}: {why}", path.display()))?;
            total_of(&text).ok_or_else(|| format!("callgrind left no total in {}", path.display()))
        };
        (1..=self.started).map(count).sum()
    }
}

impl Drop for Counted {
    fn drop(&mut self) {
        if !self.is_kept {
            // What is left there is temporary anyway.
            let _ = fs::remove_dir_all(&self.directory);
        }
    }
}

/// The total of a file of callgrind: the sum of its lines `totals:`, one for each dump.
fn total_of(text: &str) -> Option<u64> {
    let totals = text.lines().filter_map(|line| line.strip_prefix("totals:"));
    let totals: Vec<u64> = totals.map(|total| total.trim().parse().ok()).collect::<Option<_>>()?;
    (!totals.is_empty()).then(|| totals.iter().sum())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn total_is_the_sum_of_all_dumps() {
        assert_eq!(total_of("events: Ir\n1 2\ntotals: 70\n"), Some(70));
        assert_eq!(total_of("totals: 70\n\nevents: Ir\ntotals: 7\n"), Some(77));
        assert_eq!(total_of("events: Ir\n"), None);
        assert_eq!(total_of("totals: many\n"), None);
    }
}

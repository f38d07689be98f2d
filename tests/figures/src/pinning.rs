//! Pinning of the ends of a case to CPUs, so that the scheduler does not decide the result.

use rustix::thread::{CpuSet, sched_setaffinity};

/// Exceeds the number of CPUs of any machine in use.
const CPUS_MAX: usize = 256;

/// Pinning of the processes or threads of a case to CPUs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pinning {
    /// No pinning: the scheduler decides.
    Anywhere,
    /// Everything on the first CPU.
    OneCpu,
    /// The measuring end on the first CPU, the echoing end on the second.
    OneCpuEach,
}

/// An end that is to be pinned.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum End {
    /// Sends first and measures the time.
    Measuring,
    /// Echoes.
    Echoing,
    /// Any other participant: a node between the ends, or the senders of a crowd.
    Other,
}

impl Pinning {
    /// All variants.
    pub const ALL: [Self; 3] = [Self::Anywhere, Self::OneCpu, Self::OneCpuEach];

    /// The name used in the output of the benches.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Anywhere => "anywhere",
            Self::OneCpu => "one_cpu",
            Self::OneCpuEach => "one_cpu_each",
        }
    }

    /// The variant with this name.
    ///
    /// # Panics
    /// If there is none: a bench reads only names that it wrote itself.
    #[must_use]
    pub fn named(name: &str) -> Self {
        let found = Self::ALL.into_iter().find(|pinning| pinning.name() == name);
        found.expect("a name that this program wrote itself")
    }

    /// The CPU of this end, if it is pinned.
    #[must_use]
    pub const fn cpu(self, end: End) -> Option<usize> {
        match (self, end) {
            (Self::Anywhere, _) | (Self::OneCpuEach, End::Other) => None,
            (Self::OneCpu, _) | (Self::OneCpuEach, End::Measuring) => Some(0),
            (Self::OneCpuEach, End::Echoing) => Some(1),
        }
    }

    /// Pins the calling thread, and all threads and processes that it starts, to the CPUs of this end. If the
    /// system refuses, prints a message and continues.
    pub fn pin(self, end: End) {
        if self == Self::Anywhere {
            return;
        }
        let mut set = CpuSet::new();
        match self.cpu(end) {
            Some(cpu) => set.set(cpu),
            // The mask inherited from the measuring end is too narrow. CPUs that do not exist are ignored.
            None => (0..CPUS_MAX).for_each(|cpu| set.set(cpu)),
        }
        if let Err(error) = sched_setaffinity(None, &set) {
            eprintln!("not pinned as {self:?} wants {end:?}: {error}");
        }
    }
}

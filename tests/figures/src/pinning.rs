//! Which CPUs the ends of a case use, so that the scheduler does not decide what is measured.

use rustix::thread::{CpuSet, sched_setaffinity};

/// More than a machine of ours has.
const CPUS_MAX: usize = 256;

/// Which CPUs the processes or threads of a case use.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pinning {
    /// Wherever the scheduler likes.
    Anywhere,
    /// All on the first CPU.
    OneCpu,
    /// The measuring end on the first CPU, the echoing one on the second.
    OneCpuEach,
}

/// Who is to be pinned.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum End {
    /// Sends first, and takes the time.
    Measuring,
    /// Answers.
    Echoing,
    /// Stands between them or beside them: a node, the senders of a crowd.
    Other,
}

impl Pinning {
    /// All three.
    pub const ALL: [Self; 3] = [Self::Anywhere, Self::OneCpu, Self::OneCpuEach];

    /// As it stands in the benches' lines.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Anywhere => "anywhere",
            Self::OneCpu => "one_cpu",
            Self::OneCpuEach => "one_cpu_each",
        }
    }

    /// The one with that name.
    ///
    /// # Panics
    /// If there is none: a bench reads the names that it wrote itself.
    #[must_use]
    pub fn named(name: &str) -> Self {
        let found = Self::ALL.into_iter().find(|pinning| pinning.name() == name);
        found.expect("a name that this program wrote itself")
    }

    /// The CPU of this end, if it has a certain one.
    #[must_use]
    pub const fn cpu(self, end: End) -> Option<usize> {
        match (self, end) {
            (Self::Anywhere, _) | (Self::OneCpuEach, End::Other) => None,
            (Self::OneCpu, _) | (Self::OneCpuEach, End::Measuring) => Some(0),
            (Self::OneCpuEach, End::Echoing) => Some(1),
        }
    }

    /// Keeps the calling thread, and the threads and processes that it makes, on the CPUs of this end. Where the machine
    /// does not allow it, that is said, and the run goes on.
    pub fn pin(self, end: End) {
        if self == Self::Anywhere {
            return;
        }
        let mut set = CpuSet::new();
        match self.cpu(end) {
            Some(cpu) => set.set(cpu),
            // The mask of the measuring end was inherited, which is too narrow; what the machine lacks is left out.
            None => (0..CPUS_MAX).for_each(|cpu| set.set(cpu)),
        }
        if let Err(error) = sched_setaffinity(None, &set) {
            eprintln!("not pinned as {self:?} wants {end:?}: {error}");
        }
    }
}

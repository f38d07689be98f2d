//! A node in a process of its own, a directory that belongs to nobody else, and a cast that is started in it.

use std::{
    fmt,
    path::{Path, PathBuf},
    sync::mpsc::{Receiver, sync_channel},
};

use sinew::audit::Audit;

use super::Performer;
use crate::{DEADLINE, OwnDirectory, preload::Preload};

/// What the node may hold.
#[derive(Clone, Copy, Debug)]
pub struct StageLimits {
    /// `node.mailbox_capacity`.
    pub mailbox_capacity: usize,
    /// `node.payload_max`.
    pub payload_max: usize,
    /// `lncl.clients_max`; one process may have a quarter of it.
    pub clients_max: usize,
}

/// What the processes of a stage run on.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Kernel {
    /// The kernel that is there.
    #[default]
    Present,
    /// As one before Linux 6.16: it cannot be told to let no descriptors come over a socket.
    WithoutPassRights,
}

impl Kernel {
    /// What makes it this one for a process.
    fn environment(self, directory: &OwnDirectory) -> Environment {
        match self {
            Self::Present => Vec::new(),
            Self::WithoutPassRights => {
                let library = Preload::build(&directory.join(""), "old_kernel", include_str!("old_kernel.c"));
                vec![(Preload::VARIABLE, library.path().to_owned())]
            }
        }
    }
}

impl fmt::Display for Kernel {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Present => "the kernel that is there",
            Self::WithoutPassRights => "a kernel without SO_PASSRIGHTS",
        })
    }
}

/// Variables of the environment of every process of a stage.
type Environment = Vec<(&'static str, PathBuf)>;

/// Has glibc's allocator take each buffer of 128 KiB or more from the host, and give it back when it is freed: with any value set
/// the threshold stays where it is, and does not grow with what is freed (mallopt(3), `M_MMAP_THRESHOLD`). Else each arena keeps
/// up to twice the longest that was freed, which nobody holds.
const GIVE_BACK: (&str, &str) = ("GLIBC_TUNABLES", "glibc.malloc.mmap_threshold=131072");

/// Where a proof takes place.
#[derive(Debug)]
pub struct Stage {
    program: PathBuf,
    environment: Environment,
    residents: Vec<String>,
    /// Ends before its directory does.
    node: Performer,
    answers: Receiver<String>,
    directory: OwnDirectory,
}

impl Stage {
    /// Starts the node. `program` is one whose `main` calls [`play`](super::play) first.
    ///
    /// # Panics
    /// If it does not start.
    #[must_use]
    pub fn new(program: &Path, limits: StageLimits) -> Self {
        Self::on(Kernel::Present, program, limits)
    }

    /// The same on this kernel.
    pub(super) fn on(kernel: Kernel, program: &Path, limits: StageLimits) -> Self {
        Self::begin(program, limits, &[], |directory| kernel.environment(directory), |_| {})
    }

    /// The same, with processes whose allocator keeps nothing of long messages: their growth is what they hold.
    ///
    /// # Panics
    /// If it does not start.
    #[must_use]
    pub fn that_gives_back(program: &Path, limits: StageLimits) -> Self {
        let (variable, value) = GIVE_BACK;
        Self::begin(program, limits, &[], |_| vec![(variable, value.into())], |_| {})
    }

    /// The same, with posters in the node's own process: these arguments, and whoever hears what they tell.
    pub(super) fn with_residents(
        program: &Path,
        limits: StageLimits,
        residents: &[String],
        hear: impl FnMut(&str) + Send + 'static,
    ) -> Self {
        Self::begin(program, limits, residents, |_| Vec::new(), hear)
    }

    fn begin(
        program: &Path,
        limits: StageLimits,
        residents: &[String],
        environment: impl FnOnce(&OwnDirectory) -> Environment,
        hear: impl FnMut(&str) + Send + 'static,
    ) -> Self {
        let directory = OwnDirectory::new();
        for name in ["run", "tmp"] {
            std::fs::create_dir(directory.join(name)).expect("the test's own directory");
        }
        let (socket, config) = (directory.join("run").join("node.sock"), directory.join("node.toml"));
        let StageLimits { mailbox_capacity, payload_max, clients_max } = limits;
        // One process leaves room for others.
        let share = clients_max / 4;
        let text = format!(
            "[node]\nname = \"stage\"\nmailbox_capacity = {mailbox_capacity}\npayload_max = {payload_max}\n\
             [lncl]\nsocket = {socket:?}\nclients_max = {clients_max}\nclients_per_process_max = {share}\n[supervision]\nlayer_restarts_max = 100\n[ndl]\nmulticast = false\nmdns_port = false\n"
        );
        std::fs::write(&config, text).expect("the test's own directory");
        let mut environment = environment(&directory);
        environment.push(("TMPDIR", directory.join("tmp")));
        let (node, answers) = open(program, &environment, &directory, residents, hear);
        let (program, residents) = (program.to_owned(), residents.to_owned());
        let stage = Self { program, environment, residents, node, answers, directory };
        stage.wait_for("open");
        stage
    }

    /// Kills the node, and starts another one behind the same door.
    ///
    /// # Panics
    /// If it does not start.
    pub fn replace_node(&mut self) {
        self.node.kill_now();
        (self.node, self.answers) =
            open(&self.program, &self.environment, &self.directory, &self.residents, |_| {});
        self.wait_for("open");
    }

    /// Lets the node's LNCL panic. It is back soon.
    pub fn panic_lncl(&mut self) {
        self.node.tell("panic");
    }

    fn wait_for(&self, word: &str) -> String {
        let answer = self.answers.recv_timeout(DEADLINE).unwrap_or_else(|_| panic!("the node says {word:?}"));
        answer
            .strip_prefix(word)
            .unwrap_or_else(|| panic!("{answer:?} instead of {word:?}"))
            .trim()
            .to_owned()
    }

    /// Starts a process in this role; each line that it says is given to `hear`. Its first argument is the socket.
    pub fn start(
        &self,
        role: &str,
        arguments: &[String],
        hear: impl FnMut(&str) + Send + 'static,
    ) -> Performer {
        let socket = self.socket().display().to_string();
        let arguments: Vec<String> = [socket].into_iter().chain(arguments.iter().cloned()).collect();
        Performer::start_with(&self.program, role, &arguments, &self.environment, hear)
    }

    /// The path of the node's socket.
    #[must_use]
    pub fn socket(&self) -> PathBuf {
        self.directory.join("run").join("node.sock")
    }

    /// The process id of the node.
    #[must_use]
    pub fn node_id(&self) -> u32 {
        self.node.id()
    }

    /// Tells the posters in the node's own process to send no more.
    pub(super) fn quiet(&mut self) {
        self.node.tell("quiet");
    }

    /// How much the node has refused so far.
    ///
    /// # Panics
    /// If it does not say.
    pub fn refused(&mut self) -> u64 {
        self.node.tell("refused");
        self.wait_for("refused").parse().expect("a number")
    }

    /// What the node says of where every message is.
    ///
    /// # Panics
    /// If it does not say.
    pub fn audit(&mut self) -> Audit {
        self.node.tell("audit");
        serde_json::from_str(&self.wait_for("audit")).expect("an audit")
    }

    /// The files in the directories that the node and the cast may write to: beside the socket, and temporary ones.
    #[must_use]
    pub fn files(&self) -> Vec<PathBuf> {
        let list =
            |name: &str| std::fs::read_dir(self.directory.join(name)).expect("the stage's own directory");
        let mut files: Vec<_> =
            ["run", "tmp"].iter().flat_map(|name| list(name)).flatten().map(|entry| entry.path()).collect();
        files.sort();
        files
    }

    /// Ends the node in order.
    ///
    /// # Panics
    /// If it does not, or not in order, or leaves a file behind.
    pub fn end(self) {
        let Self { node, directory, .. } = self;
        let status = node.end();
        assert!(status.success(), "the node ended with {status}");
        let left = std::fs::read_dir(directory.join("run")).expect("the stage's own directory").count();
        assert_eq!(left, 0, "files are left beside the socket");
    }
}

/// Starts a node with the stage's configuration: its process, and what it says to its director.
fn open(
    program: &Path,
    environment: &Environment,
    directory: &OwnDirectory,
    residents: &[String],
    mut hear: impl FnMut(&str) + Send + 'static,
) -> (Performer, Receiver<String>) {
    let (say, answers) = sync_channel(64);
    let config = directory.join("node.toml").display().to_string();
    let arguments: Vec<_> = [config].into_iter().chain(residents.iter().cloned()).collect();
    let node = Performer::start_with(program, "door", &arguments, environment, move |line| {
        if line.starts_with(|first: char| first.is_ascii_digit()) {
            return hear(line);
        }
        // Nobody waits for its answers any more when the stage is gone.
        let _ = say.send(line.to_owned());
    });
    (node, answers)
}

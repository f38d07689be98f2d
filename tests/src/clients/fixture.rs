//! A node in a process of its own, a private directory, and the processes started beside the node.

use std::{fmt, path::PathBuf};

use sinew::audit::Audit;
use sinew_testkit::{NodeProcess, TestDirectory, preload::Preload};

use crate::role;

/// The limits of the node.
#[derive(Clone, Copy, Debug)]
pub struct FixtureLimits {
    /// `node.mailbox_capacity`.
    pub mailbox_capacity: usize,
    /// `node.payload_max`.
    pub payload_max: usize,
    /// `lncl.clients_max`; one process may have a quarter of it.
    pub clients_max: usize,
}

/// The kernel that the processes of a fixture see.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Kernel {
    /// The kernel of the machine.
    #[default]
    Present,
    /// A kernel before Linux 6.16: it cannot refuse descriptors that arrive over a socket.
    WithoutPassRights,
}

impl Kernel {
    /// The environment variables that emulate this kernel for a process.
    fn environment(self, directory: &TestDirectory) -> Environment {
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

/// Environment variables of every process of a fixture.
type Environment = Vec<(&'static str, PathBuf)>;

/// Makes glibc's allocator map each buffer of 128 KiB or more separately, and unmap it when it is freed. With
/// any value set, the threshold is fixed and does not grow with the freed buffers (mallopt(3),
/// `M_MMAP_THRESHOLD`). Otherwise each arena keeps up to twice the size of the longest freed buffer.
const GIVE_BACK: (&str, &str) = ("GLIBC_TUNABLES", "glibc.malloc.mmap_threshold=131072");

/// A node, its directory, and the start of other processes.
#[derive(Debug)]
pub struct NodeFixture {
    environment: Environment,
    residents: Vec<String>,
    /// Dropped before its directory.
    node: NodeProcess,
    directory: TestDirectory,
}

impl NodeFixture {
    /// Starts the node.
    ///
    /// # Panics
    /// If it does not start.
    #[must_use]
    pub fn new(limits: FixtureLimits) -> Self {
        Self::on(Kernel::Present, limits)
    }

    /// Like [`new`](Self::new), on this kernel.
    pub(super) fn on(kernel: Kernel, limits: FixtureLimits) -> Self {
        Self::start_node(limits, &[], |directory| kernel.environment(directory), |_| false)
    }

    /// Like [`new`](Self::new), with processes that return long buffers to the system: their memory growth is
    /// the memory that they hold.
    ///
    /// # Panics
    /// If it does not start.
    #[must_use]
    pub fn that_gives_back(limits: FixtureLimits) -> Self {
        let (variable, value) = GIVE_BACK;
        Self::start_node(limits, &[], |_| vec![(variable, value.into())], |_| false)
    }

    /// The same with posters in the node's own process: their arguments, and the function that receives their
    /// reports.
    pub(super) fn with_residents(
        limits: FixtureLimits,
        residents: &[String],
        mut report: impl FnMut(&str) + Send + 'static,
    ) -> Self {
        let take = move |line: &str| {
            let is_report = line.starts_with(|first: char| first.is_ascii_digit());
            if is_report {
                report(line);
            }
            is_report
        };
        Self::start_node(limits, residents, |_| Vec::new(), take)
    }

    fn start_node(
        limits: FixtureLimits,
        residents: &[String],
        environment: impl FnOnce(&TestDirectory) -> Environment,
        take: impl FnMut(&str) -> bool + Send + 'static,
    ) -> Self {
        let directory = TestDirectory::new();
        for name in ["run", "tmp"] {
            std::fs::create_dir(directory.join(name)).expect("the test's own directory");
        }
        let socket = directory.join("run").join("node.sock");
        let FixtureLimits { mailbox_capacity, payload_max, clients_max } = limits;
        // Leaves room for other processes beside the largest one.
        let share = clients_max / 4;
        let text = format!(
            "[node]\nname = \"stage\"\nmailbox_capacity = {mailbox_capacity}\npayload_max = {payload_max}\n\
             [lncl]\nsocket = {socket:?}\nclients_max = {clients_max}\nclients_per_process_max = {share}\n[supervision]\nlayer_restarts_max = 100\n[ndl]\nmulticast = false\nmdns_port = false\n"
        );
        let _ = directory.write("node.toml", &text);
        let mut environment = environment(&directory);
        environment.push(("TMPDIR", directory.join("tmp")));
        let node = open(&environment, &directory, residents, take);
        Self { environment, residents: residents.to_owned(), node, directory }
    }

    /// Kills the node, and starts another one with the same client socket.
    ///
    /// # Panics
    /// If it does not start.
    pub fn replace_node(&mut self) {
        self.node.kill();
        self.node = open(&self.environment, &self.directory, &self.residents, |_| false);
    }

    /// Makes the node's LNCL panic. It restarts soon.
    pub fn panic_lncl(&mut self) {
        self.node.send_line("panic");
    }

    /// Starts a process in this role, with the socket as its first argument.
    #[must_use]
    pub fn start(&self, role: &str, arguments: &[&str]) -> NodeProcess {
        self.start_with(role, arguments, |_| false)
    }

    /// The same. A line of its output for which `take` returns `true` is not captured.
    pub fn start_with(
        &self,
        name: &str,
        arguments: &[&str],
        take: impl FnMut(&str) -> bool + Send + 'static,
    ) -> NodeProcess {
        let mut command = role(name);
        command.arg(self.socket()).args(arguments);
        command.envs(self.environment.iter().map(|(variable, value)| (variable, value)));
        NodeProcess::start_with(name, command, take)
    }

    /// The path of the node's socket.
    #[must_use]
    pub fn socket(&self) -> PathBuf {
        self.directory.join("run").join("node.sock")
    }

    /// The node's process.
    #[must_use]
    pub const fn node(&self) -> &NodeProcess {
        &self.node
    }

    /// Tells the posters in the node's own process to stop sending.
    pub(super) fn quiet(&mut self) {
        self.node.send_line("quiet");
    }

    /// Number of refusals of the node so far.
    ///
    /// # Panics
    /// If it does not answer.
    pub fn refused(&mut self) -> u64 {
        self.node.send_line("refused");
        self.node.expect("refused").parse().expect("a number")
    }

    /// The node's audit of all messages.
    ///
    /// # Panics
    /// If it does not answer.
    pub fn audit(&mut self) -> Audit {
        self.node.send_line("audit");
        serde_json::from_str(&self.node.expect("audit")).expect("an audit")
    }

    /// The files in the directories to which the node and the other processes may write: the one of the
    /// socket, and the one for temporary files.
    #[must_use]
    pub fn files(&self) -> Vec<PathBuf> {
        let list =
            |name: &str| std::fs::read_dir(self.directory.join(name)).expect("the fixture's own directory");
        let mut files: Vec<_> =
            ["run", "tmp"].iter().flat_map(|name| list(name)).flatten().map(|entry| entry.path()).collect();
        files.sort();
        files
    }

    /// Ends the node in order.
    ///
    /// # Panics
    /// If it does not end, fails, or leaves a file behind.
    pub fn end(self) {
        let Self { node, directory, .. } = self;
        let status = node.stop();
        assert!(status.success(), "the node ended with {status}");
        let left = std::fs::read_dir(directory.join("run")).expect("the fixture's own directory").count();
        assert_eq!(left, 0, "files are left beside the socket");
    }
}

/// Starts a node with the fixture's configuration, and returns when its socket is open.
fn open(
    environment: &Environment,
    directory: &TestDirectory,
    residents: &[String],
    take: impl FnMut(&str) -> bool + Send + 'static,
) -> NodeProcess {
    let mut command = role("client-node");
    command.arg(directory.join("node.toml")).args(residents);
    command.envs(environment.iter().map(|(variable, value)| (variable, value)));
    let mut node = NodeProcess::start_with("the node", command, take);
    node.expect("open");
    node
}

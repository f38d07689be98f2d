//! The environment of the programs in C and C++: a compiler, a node in a process of its own, a directory, and
//! endpoints in Rust beside them.

use std::{
    io::Write,
    path::{Path, PathBuf},
    process::{Command, Stdio},
};

use sinew::{Endpoint, NodeApi, Registration};
use sinew_testkit::{NodeProcess, TestDirectory, own_group, program};

/// Time limit for events that must occur, as on a loaded machine.
pub(crate) const WATCHDOG: std::time::Duration = sinew_testkit::DEADLINE;

/// Strict warnings of the compilers.
const STRICT: [&str; 4] = ["-Wall", "-Wextra", "-Werror", "-pedantic"];

/// A compiler, as the user would call it.
#[derive(Clone, Copy)]
pub(crate) struct Compiler {
    command: &'static str,
    standard: &'static str,
}

pub(crate) const C99: Compiler = Compiler { command: "gcc", standard: "-std=c99" };
pub(crate) const C: Compiler = Compiler { command: "gcc", standard: "-std=c11" };
pub(crate) const CPP: Compiler = Compiler { command: "g++", standard: "-std=c++17" };
pub(crate) const CPP20: Compiler = Compiler { command: "g++", standard: "-std=c++20" };

/// The directory of the library: beside this test, which is linked with it.
fn library_directory() -> PathBuf {
    let test = std::env::current_exe().expect("a test has a path");
    test.parent().expect("it lies in a directory").to_owned()
}

impl Compiler {
    /// Compiles a source of this package and links it with the shared library.
    pub(crate) fn shared(self, source: &str, ground: &Ground) -> PathBuf {
        let library = library_directory();
        let path = format!("-Wl,-rpath,{}", library.display());
        let search = format!("-L{}", library.display());
        self.compile(source, ground, &[&search, "-lsinew_c", &path, "-lm", "-pthread"])
    }

    /// As [`Self::shared`], with the static library.
    pub(crate) fn static_(self, source: &str, ground: &Ground) -> PathBuf {
        let library = library_directory().join("libsinew_c.a").display().to_string();
        self.compile(source, ground, &[&library, "-lm", "-lpthread", "-ldl"])
    }

    /// Returns the compiler's errors about a source that it rejects.
    pub(crate) fn refuses(self, source: &str) -> String {
        let package = Path::new(env!("CARGO_MANIFEST_DIR"));
        let mut command = Command::new(self.command);
        command.arg(self.standard).args(STRICT).arg("-fsyntax-only").arg("-I").arg(package.join("include"));
        command.args(["-x", if self.command == "gcc" { "c" } else { "c++" }, "-"]).env("LC_ALL", "C");
        let piped = command.stdin(Stdio::piped()).stdout(Stdio::null()).stderr(Stdio::piped());
        let mut compiling = piped.spawn().expect("the compiler runs: it did before");
        let mut stdin = compiling.stdin.take().expect("it is piped");
        stdin.write_all(source.as_bytes()).expect("it reads its source");
        drop(stdin);
        let output = compiling.wait_with_output().expect("it ends");
        assert!(!output.status.success(), "this compiles:\n{source}");
        String::from_utf8_lossy(&output.stderr).into_owned()
    }

    fn compile(self, source: &str, ground: &Ground, link: &[&str]) -> PathBuf {
        let package = Path::new(env!("CARGO_MANIFEST_DIR"));
        let source = package.join(source);
        let program = ground.directory.join(&source.file_stem().expect("a source").to_string_lossy());
        let mut command = Command::new(self.command);
        command.arg(self.standard).args(STRICT).arg("-g").arg("-I").arg(package.join("include"));
        command.arg(source).args(link).arg("-o").arg(&program);
        let output = command.output().expect("the compiler runs: it did before");
        let errors = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success(), "{command:?} prints:\n{errors}");
        program
    }
}

/// Whether a command is installed. If not, prints that the test is skipped, and why.
pub(crate) fn is_there(command: &str) -> bool {
    let is_there = Command::new(command).arg("--version").output().is_ok();
    if !is_there {
        println!("skipped: there is no `{command}` on this machine");
    }
    is_there
}

fn start_node(config: &Path) -> NodeProcess {
    let mut command = Command::new(program("sinew-node"));
    command.arg(config);
    let mut node = NodeProcess::start("sinew-node", command);
    node.wait_for(&["up"]);
    node
}

/// An endpoint in Rust at the node of the programs.
pub(crate) fn endpoint(ground: &Ground, registration: Registration) -> Endpoint {
    let node = NodeApi::connect(ground.socket()).expect("the node is up");
    node.register_transport_address(registration.deadline(WATCHDOG)).expect("nothing is in the way")
}

/// A node in a process of its own, and a directory for its socket and for the programs.
pub(crate) struct Ground {
    pub(crate) node: NodeProcess,
    directory: TestDirectory,
}

impl Ground {
    pub(crate) fn new() -> Self {
        let directory = TestDirectory::new();
        let config = directory.join("node.toml");
        let socket = directory.join("node.sock");
        let group = own_group();
        let lines = format!(
            "[node]\nname = \"knee\"\npayload_max = 65536\n[lncl]\nsocket = \"{}\"\n[ndl]\nmulticast = \"{group}\"\nmdns_port = false\n",
            socket.display()
        );
        std::fs::write(&config, lines).expect("the test's own directory can be written to");
        Self { node: start_node(&config), directory }
    }

    /// Starts the node again, after it has ended.
    pub(crate) fn start_node_again(&mut self) {
        self.node = start_node(&self.directory.join("node.toml"));
    }

    /// The socket of the node.
    pub(crate) fn socket(&self) -> PathBuf {
        self.directory.join("node.sock")
    }

    /// Starts a program that gets the node's socket as its first argument.
    pub(crate) fn start(&self, program: &Path, arguments: &[&str]) -> NodeProcess {
        self.start_under(&[], program, arguments)
    }

    /// Runs a program that does all checks itself: it has to print `line`, and exit with success.
    pub(crate) fn run(&self, program: &Path, line: &str) {
        let mut running = self.start(program, &[]);
        running.wait_for(&[line]);
        assert_eq!(running.wait_for_exit(), Some(0));
    }

    /// Starts a program under another one. Their standard errors are captured, too.
    pub(crate) fn start_under(&self, over: &[&str], program: &Path, arguments: &[&str]) -> NodeProcess {
        let mut command = Command::new("sh");
        command.args(["-c", r#"exec "$@" 2>&1"#, "sh"]).args(over).arg(program);
        command.arg(self.socket()).args(arguments);
        // Cargo's own search path may lead to the library of an earlier build.
        command.env_remove("LD_LIBRARY_PATH");
        NodeProcess::start(&program.display().to_string(), command)
    }

    /// As [`Self::start`], with all of the library's log on this standard error.
    pub(crate) fn start_logging_to(&self, stderr: impl Into<Stdio>, program: &Path) -> NodeProcess {
        let mut command = Command::new(program);
        command.arg(self.socket()).env("SINEW_LOG", "debug").stderr(stderr);
        command.env_remove("LD_LIBRARY_PATH");
        NodeProcess::start(&program.display().to_string(), command)
    }
}

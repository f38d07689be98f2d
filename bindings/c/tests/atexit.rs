//! A node that runs until its process ends, as in a plug-in or a Python module: a function registered with
//! `atexit` stops it.
//!
//! The thread-local variables of the thread that ends the process are destroyed by then. Whether that
//! disturbs the stop is a race, so there are many runs. This program starts itself again for each.

use std::{
    io::{Write, stdout},
    process::{Command, ExitCode},
    sync::Mutex,
    thread,
};

use sinew::{NodeConfig, prelude::*};
use sinew_testkit::{DEADLINE, NodeProcess, TestDirectory, own_group};

/// Runs of the node in each mode.
const RUNS: u32 = 20;
/// The exit code of each run.
const CODE: u8 = 3;
/// The end of a run: `main` returns, `main` calls `exit`, or another thread does.
const MODES: [&str; 3] = ["return", "exit", "exit-of-a-thread"];

static NODE: Mutex<Option<Node>> = Mutex::new(None);

struct Idle(&'static str);

impl Actor for Idle {
    type Context = AppContext<Self>;

    fn stopped(&mut self, _: &mut Self::Context) {
        print_line(&format!("{} has stopped", self.0));
    }
}

fn print_line(line: &str) {
    // There is no reader if the test has failed already.
    let _ = writeln!(stdout(), "{line}");
}

extern "C" fn at_exit() {
    let node = NODE.lock().ok().and_then(|mut node| node.take());
    if let Some(node) = node {
        print_line(&format!("the node has ended: {:?}", node.stop()));
    }
}

fn run_node(mode: &str, config: &str) -> ExitCode {
    let config = NodeConfig::from_file(config).expect("the test's own file");
    let node = Node::builder("held")
        .config(config)
        .app(AppSpec::new("shared", || Idle("shared")))
        .app(AppSpec::new("alone", || Idle("alone")).own_thread())
        .start()
        .expect("it starts");
    node.handle().wait_until_running(DEADLINE).expect("it runs");
    *NODE.lock().expect("no thread has panicked") = Some(node);
    // SAFETY: the function takes nothing, returns nothing, and lives as long as the program; a panic in it
    // ends the process at once.
    let registered = unsafe { libc::atexit(at_exit) };
    assert_eq!(registered, 0, "there is room for a handler");
    match mode {
        "exit" => std::process::exit(CODE.into()),
        "exit-of-a-thread" => {
            let ends = thread::spawn(|| std::process::exit(CODE.into()));
            let _ = ends.join();
        }
        _ => {}
    }
    ExitCode::from(CODE)
}

fn prove(mode: &str) {
    let directory = TestDirectory::new();
    let (config, socket) = (directory.join("held.toml"), directory.join("held.sock"));
    let text = format!(
        "[node]\nname = \"held\"\naddress = \"127.0.0.1\"\nproject = \"atexit\"\n[lncl]\nsocket = {socket:?}\n\
         [ndl]\nmulticast = \"{}\"\nmdns_port = false\n",
        own_group()
    );
    std::fs::write(&config, text).expect("the test's own directory");
    let this = std::env::current_exe().expect("a test has a path");
    for run in 1..=RUNS {
        let mut command = Command::new(&this);
        command.args(["--run", mode]).arg(&config);
        let mut program = NodeProcess::start(mode, command);
        let code = program.wait_for_exit();
        let output = program.output();
        let has_printed = |words: &str| output.iter().any(|line| line.contains(words));
        let words = ["shared has stopped", "alone has stopped", "the node has ended: Stopped"];
        let is_ordered = words.into_iter().all(has_printed);
        assert_eq!((code, is_ordered), (Some(CODE.into()), true), "{mode}, run {run}: {output:#?}");
        assert!(!socket.exists(), "{mode}, run {run}: the socket file stays");
    }
    println!("{mode}: {RUNS} runs stopped in order");
}

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    match arguments.iter().map(String::as_str).collect::<Vec<_>>()[..] {
        ["--run", mode, config] => run_node(mode, config),
        _ => {
            MODES.into_iter().for_each(prove);
            ExitCode::SUCCESS
        }
    }
}

//! The command line.

use std::{path::PathBuf, time::Duration};

use clap::{CommandFactory as _, FromArgMatches as _, Parser, Subcommand};

use crate::{bag, keys, logs, param, play, record, send, stop, up, view, watch, why};

/// Shows a running Sinew system, from any one node of it. It changes nothing, except that `send` and `play` send
/// messages, `param` and the page of `view` set parameters, `stop` stops the system, `up` and `down` start and end its
/// nodes, and `keys`, `record`, `bag` and `man` write files.
///
/// It connects to the socket of a node on this machine (`lncl.socket` in the node's configuration) and asks
/// that node, and through it all others.
#[derive(Debug, Parser)]
#[command(name = "sinew", version, after_help = AFTER)]
pub(crate) struct Arguments {
    /// The socket of a node on this machine. Without it: $SINEW_SOCKET, else the first that answers of
    /// $XDG_RUNTIME_DIR/sinew/*.sock, /run/sinew/*.sock, /tmp/sinew-*.sock; of these only one of this user or
    /// root, with a listening process of this user or root
    #[arg(long, global = true, value_name = "PATH")]
    pub(crate) socket: Option<PathBuf>,
    /// Print JSON instead of tables; where the command cannot be carried out, an object with the reason as
    /// `fault`, beside the text on stderr
    #[arg(long, global = true)]
    pub(crate) json: bool,
    /// Show all columns, and do not wrap lines at 120 columns
    #[arg(long, global = true)]
    pub(crate) wide: bool,
    /// How long each node has for its answer
    #[arg(long, global = true, value_name = "MS", default_value_t = 2_000, value_parser = clap::value_parser!(u32).range(1..=60_000))]
    deadline_ms: u32,
    /// The command to run
    #[command(subcommand)]
    pub(crate) command: Command,
}

/// The commands.
#[derive(Debug, Subcommand)]
pub(crate) enum Command {
    /// Shows every node: address, name, up time, state, validity of its keys (or OPEN), links and round-trip time
    ///
    /// While the stop of the system is in force, its presses and the nodes that have not confirmed stand above the
    /// table, and the column STOP has the confirmation of each node. That is a finding, like a node that is lost.
    #[command(after_help = r#"Examples:
  sinew nodes
  sinew nodes --wide            all columns: incarnation, stop, routes, bounds, clock, drift
  sinew nodes --json | jq -r '.nodes[].name'
  sinew nodes --json | jq .stop"#)]
    Nodes,
    /// Shows every application: TID, name, node, and whether it is ready or why not
    #[command(after_help = r#"Examples:
  sinew apps
  sinew apps --json | jq '.apps[] | select(.ready | not)'"#)]
    Apps,
    /// Shows the supervision tree of each node, with restarts and the reason of the last one
    #[command(after_help = r#"Examples:
  sinew tree
  sinew tree knee"#)]
    Tree {
        /// A node's address or name; without it: every node
        node: Option<String>,
    },
    /// Measures the round-trip time of a confirmed message
    ///
    /// The ping goes to the application's own thread, or to the node's inspection, and is answered there
    /// without the application's code. An application in a process of its own that is connected by a socket
    /// answers it when it receives.
    #[command(after_help = r#"Examples:
  sinew ping knee.drive
  sinew ping 192.168.0.12 --count 1000"#)]
    Ping {
        /// An application's TID (127.0.0.2/80000001) or name, a node's address or name: the first that it is,
        /// in this order
        target: String,
        /// How many, each when the one before was answered; after three in a row without an answer no more
        #[arg(long, short, default_value_t = 100, value_parser = clap::value_parser!(u32).range(1..=100_000))]
        count: u32,
    },
    /// Sends a message to an application or a group, and shows its outcome
    ///
    /// The payload is written as MessagePack, as every typed payload is: the keys of the JSON object are the
    /// names of the type's fields.
    #[command(after_help = r#"Examples:
  sinew send knee.drive demo.angle '{"degrees": 5}'
  sinew send drives demo.stop                 to a group: the outcome of each member; exit code 1 if one did not take it
  sinew send knee.drive demo.status --ask     prints the reply"#)]
    Send(send::Order),
    /// Shows the messages that an application receives and sends: decoded payloads, type, class, source, age,
    /// and each type's rate once a second
    ///
    /// The copies come from the application's node, as far as it has room for them, and those of messages on
    /// direct links from the application's process: others are counted, and the application does not wait. With
    /// --json each line is an object.
    #[command(after_help = r#"Examples:
  sinew watch knee.drive --received
  sinew watch drives --kind demo.stop         messages to a group, at each member
  sinew watch knee.drive --rates --for 10
  sinew watch knee.drive --wait               also where nothing has this name yet
  sinew watch knee.drive --json | jq .payload"#)]
    Watch(watch::Order),
    /// Shows the log lines of all nodes in the order of time: time, level, node, part of the program, text
    ///
    /// Each node keeps its newest lines in memory, at most 2,048. Missing ones are counted, and a node that cannot be
    /// asked is named. Times are those of this host: the clocks of other nodes are measured. With --json each line is
    /// an object.
    #[command(after_help = r#"Examples:
  sinew logs
  sinew logs -f --since 10s
  sinew logs --node knee --level warn
  sinew logs -f --json | jq -r 'select(.level == "error") | .text'
  sinew logs --robot my-leg.toml              the output of the nodes' processes, also of ended ones"#)]
    Logs(logs::Order),
    /// Shows nodes, applications, links and losses on the terminal, twice a second: rates, queues, lateness, guards
    ///
    /// Keys: q ends it, the arrows and the page keys scroll, / filters the rows by a text, p pauses. Where standard
    /// output is no terminal, or with --json, it prints one table of the rates within a second, and ends.
    #[command(after_help = r#"Examples:
  sinew top
  sinew top --json | jq '.losses'"#)]
    Top,
    /// Records the messages of the node's applications into an MCAP file, until Ctrl-C
    ///
    /// The node writes its messages into memory, and this command writes them to the file: no sender waits for it.
    /// Messages that it was too slow for are counted, and the file states them: `sinew bag check` proves it.
    /// Only the node's user and root may record.
    #[command(after_help = r#"Examples:
  sinew record walk.mcap
  sinew record --for 30s --app 'knee.*' --type demo.angle
  sinew record --split 5m --max-size 10G
  sinew record freeze                         keeps the messages around this moment, on all nodes
  sinew record walk.mcap --json | jq .dropped"#)]
    Record(record::Order),
    /// Sends the messages of a recording again, or checks a program against them
    ///
    /// Each recorded application is registered under its name, and its messages go to the destinations with the
    /// recorded names, at the times at which they were sent. Without --live that is in a project of its own on
    /// loopback, `replay`. Protected commands are never sent into a live system.
    ///
    /// With --check it sends nothing: it runs PROGRAM in virtual time on the messages that it received, and compares
    /// all that it sends. Exit code 1 if a message differs: the first one is named with its field and both values.
    #[command(after_help = r#"Examples:
  sinew play walk.mcap
  sinew play walk.mcap --rate 0.5 --from 10s --to 20s --loop
  sinew play walk.mcap --source 'knee.*' --live
  sinew play --check walk.mcap -- target/release/knee knee.toml
  sinew play --check walk.mcap --app knee.drive --ignore t_ns --start-before 1ms -- target/release/knee knee.toml"#)]
    Play(play::Order),
    /// Serves the state of all nodes as a page, and as metrics for Prometheus, until Ctrl-C
    ///
    /// The command prints the address of the page, with the token of this start: it shows nodes, links, applications
    /// and messages, and sets parameters with the rights that the nodes give to this command. GET /metrics has the
    /// metrics, without a token. All nodes are asked at most three times a second, and only while requests come or a
    /// page is open. Requests for other hosts than localhost and the address of --listen are refused. Dashboard and
    /// alert rules: view/grafana.json and view/alerts.yml of the source.
    #[command(after_help = r#"Examples:
  sinew view                                  prints the address of the page
  curl http://127.0.0.1:9464/metrics
  sinew view --listen 192.168.0.10:9464       for a Prometheus server on another machine; there is no encryption"#)]
    View(view::Order),
    /// Finds out why two nodes or applications cannot communicate: each step, from both ends, with a suggested fix
    ///
    /// All nodes are asked that can be reached through any socket of this host, so that two nodes that do not
    /// know each other are both asked. Exit code 0 if the way is free.
    #[command(after_help = r#"Examples:
  sinew why hip knee
  sinew why gait knee.drive
  sinew why gait drives                       each member of a group"#)]
    Why(why::Order),
    /// Shows the structure of a payload type, for each version of it with the applications that have it
    ///
    /// All nodes are asked. Differences between a version that is sent and one that is handled are shown in words.
    #[command(after_help = r#"Examples:
  sinew schema demo.angle
  sinew schema demo.angle --json | jq '.structures[].hash'"#)]
    Schema {
        /// The name of the type, as in `payload!`
        name: String,
    },
    /// Shows which applications wait at barriers, and which ones they wait for
    #[command(after_help = r#"Examples:
  sinew barriers
  sinew barriers --json | jq .missing"#)]
    Barriers,
    /// Accounts for every message ever sent: the counters of each mailbox, client and link
    ///
    /// Each node is read twice, and both ends of each link are compared. Each unexplained difference is
    /// named, with its place or link.
    #[command(after_help = r#"Examples:
  sinew audit
  sinew audit --wide            a column for each counter"#)]
    Audit,
    /// Checks the contracts of all applications: to which state each goes when another part is lost, late or stopped
    ///
    /// Each guarded output needs a contract for its sender being lost, late and stopped. The worst time of each
    /// contract is computed from the settings, and compared with its declared time. A contract that does not close is
    /// named with the sum and the setting to change. With `contracts.dry_run` on a node its outputs are measured,
    /// too.
    ///
    /// Exit code 0: all close. 1: a contract is missing, does not close, or a node does not answer completely. 3: no
    /// node accepts the command.
    #[command(after_help = r#"Examples:
  sinew contracts
  sinew contracts --wide
  sinew contracts --json | jq '.contracts[] | select(.closes | not) | .fault'"#)]
    Contracts,
    /// Shows and sets the parameters of applications while they run
    ///
    /// A set of values is checked as a whole by its application, and applied at a tick of its loop: the command prints
    /// the tick, or the reason of the refusal. Only operators may set parameters, as the access list of the
    /// application's node names them. Without a list these are the programs of the node's own user at its socket, if
    /// the node is open and on loopback, else nobody.
    #[command(
        subcommand,
        after_help = r#"Examples:
  sinew param list
  sinew param set knee.drive.assistance=0.5
  sinew param undo knee.drive
  sinew param save walk.toml && sinew param load walk.toml"#
    )]
    Param(param::Order),
    /// Presses the stop of the whole system, releases it, and shows which nodes have confirmed
    ///
    /// Every guarded output of every node becomes safe, and stays safe until an operator has released the stop and each
    /// application has acknowledged it and armed its output again. A node that was away, or that is started anew, comes
    /// up stopped. It is no safety function: a robot that a person wears has a switch that cuts the power.
    #[command(
        subcommand,
        after_help = r#"Examples:
  sinew stop press "the person stumbles"
  sinew stop status
  sinew stop release"#
    )]
    Stop(stop::Order),
    /// Starts the nodes of a robot file on all its hosts, and waits until the robot is released
    ///
    /// The plan names for each node whether it is kept, started or started again, and why. Files are copied by the
    /// hashes of their contents, and the keys of a node only to its host: to this host directly, to others by the
    /// system's `ssh`. Nothing is stopped before all files are there. A node starts once those in its `after` are
    /// ready. Each wait has a deadline, and names the applications that block and their reasons. Run again, it changes
    /// only the nodes with a changed program, file, key or setting.
    ///
    /// Exit code 0: all nodes are ready. 1: they are not, a host cannot be reached, or a file is missing.
    #[command(after_help = r#"Examples:
  sinew up                                    the nodes of robot.toml
  sinew up --dry-run my-leg.toml
  sinew up --systemd my-leg.toml"#)]
    Up(up::UpOrder),
    /// Ends the nodes of a robot file on all its hosts, and removes their files, keys and logs
    ///
    /// Nodes end in the reverse order of their start: by SIGTERM, and by SIGKILL after `stop_within_ms`. Only processes
    /// that `sinew up` has started are ended. Files that a node has written itself stay, and are named.
    ///
    /// Exit code 0: nothing is left. 1: a host cannot be reached, or a node does not end.
    #[command(after_help = r#"Examples:
  sinew down
  sinew down my-leg.toml"#)]
    Down(up::FileOrder),
    /// Shows the nodes of a robot file on all its hosts: process, up time, and whether each is ready or why not
    ///
    /// Exit code 0: all are ready.
    #[command(after_help = r#"Examples:
  sinew status
  sinew status my-leg.toml --json | jq '.nodes[] | select(.state != "ready")'"#)]
    Status(up::FileOrder),
    /// The part of `sinew up` on a host
    #[command(hide = true)]
    Host(up::HostOrder),
    /// Reloads the access list and the deny list of the local node, without a restart
    ///
    /// A list with faults changes nothing: each is named with its line, and the list in force stays.
    /// Connections to nodes with certificates on the deny list end.
    #[command(after_help = r#"Examples:
  sinew --socket /run/sinew/knee.sock reload"#)]
    Reload,
    /// Checks the requirements of a node on this machine: interfaces, multicast, limits, real-time rights,
    /// CPU governor, clock, shared memory, sockets, open nodes, expiry of certificates. Each finding has a
    /// suggested fix
    #[command(after_help = r#"Examples:
  sinew doctor
  sinew doctor --interface eth0
  sinew doctor --rt 60          while the robot moves: how late do its real-time threads wake?"#)]
    Doctor {
        /// Interfaces that multicast is tried on, by address or by name, or `all`, with commas between them.
        /// Without it: the `ndl.interface` of the node that accepts this command, else 127.0.0.1. The test
        /// messages do not leave this machine
        #[arg(long, value_name = "INTERFACE", value_delimiter = ',')]
        interface: Vec<sinew::config::Interface>,
        /// Measures for so many seconds how late a thread of this command wakes at 1 kHz, with the ordinary schedule
        /// and with a real-time priority, 0.001 to 3600 each, and checks the real-time rights alone. A thread later
        /// than 1 ms is a finding
        #[arg(long, value_name = "SECONDS", value_parser = seconds, conflicts_with = "interface")]
        rt: Option<Duration>,
    },
    /// Makes and shows the keys of a robot: its certificate authority, and a key and a certificate for each node
    ///
    /// It asks no node. A node with keys in its configuration accepts only nodes with keys of the same
    /// project.
    #[command(
        subcommand,
        after_help = r#"Examples:
  sinew keys init walker hip=192.168.0.11 knee=192.168.0.12
  sinew keys show
  sinew keys revoke knee"#
    )]
    Keys(keys::Order),
    /// Checks, sums up, merges and exports recordings
    ///
    /// It asks no node. `sinew bag check` proves that the files of all nodes are complete.
    #[command(
        subcommand,
        after_help = r#"Examples:
  sinew bag info walk.mcap
  sinew bag check hip.mcap knee.mcap
  sinew bag merge hip.mcap knee.mcap --out leg.mcap
  sinew bag export leg.mcap --out leg --format parquet"#
    )]
    Bag(bag::Order),
    /// Prints a completion script for a shell
    #[command(after_help = r#"Examples:
  sinew completions bash > ~/.local/share/bash-completion/completions/sinew"#)]
    Completions {
        /// Which shell
        shell: clap_complete::Shell,
    },
    /// Writes a manual page of each command, for `man`
    #[command(after_help = r#"Examples:
  sinew man ~/.local/share/man/man1 && man sinew-why"#)]
    Man {
        /// An existing folder
        #[arg(value_name = "DIR")]
        folder: PathBuf,
    },
}

/// Reads the length of a measurement.
fn seconds(text: &str) -> Result<Duration, String> {
    let legal = || "a number of seconds from 0.001 to 3600, as in 10 or 0.5".to_owned();
    let seconds: f64 = text.parse().map_err(|_| legal())?;
    if (0.001..=3_600.0).contains(&seconds) { Ok(Duration::from_secs_f64(seconds)) } else { Err(legal()) }
}

/// Commands that send no request to a node: the options that select a node and its time limit do not apply to them.
const ASK_NO_NODE: [&str; 8] = ["up", "down", "status", "host", "keys", "bag", "completions", "man"];

/// The command, as its help shows it.
pub(crate) fn command() -> clap::Command {
    let command = Arguments::command();
    let hidden: Vec<_> = ["socket", "deadline_ms"]
        .iter()
        .filter_map(|id| command.get_arguments().find(|argument| argument.get_id() == *id))
        .map(|argument| argument.clone().hide(true))
        .collect();
    // One of its own of that name goes before one that is handed down to all commands.
    let without =
        |command: clap::Command, name: &str| command.mut_subcommand(name, |one| one.args(hidden.clone()));
    ASK_NO_NODE.into_iter().fold(command, without)
}

impl Arguments {
    /// Parses the command line.
    pub(crate) fn read() -> Result<Self, clap::Error> {
        let matches = command().try_get_matches()?;
        Self::from_arg_matches(&matches).map_err(|error| error.format(&mut command()))
    }

    /// How long each node has for its answer.
    pub(crate) fn within(&self) -> Duration {
        Duration::from_millis(self.deadline_ms.into())
    }
}

const AFTER: &str = "\
Exit codes:
  0  no problem was found
  1  a problem was found: a node or an application does not answer, is not ready or refuses, a message was not delivered, a name is
     unknown, a list cannot be used, keys cannot be made or are valid for less than 30 days, a recording is incomplete or cannot be read,
     a program sends other messages than those of a recording, a robot is not released
  2  the command line is wrong
  3  no node on this machine accepts this command, or that node does not answer
  4  all is fine, but standard output did not take all of it (a full disk); a reader that closes its pipe, as `head`, is no error

Examples:
  sinew nodes
  sinew ping knee.drive --count 1000
  sinew send knee.drive demo.angle '{\"degrees\": 5}'
  sinew watch knee.drive --received
  sinew logs -f --since 10s
  sinew top
  sinew record walk.mcap --for 30s
  sinew play walk.mcap --rate 0.5
  sinew why hip knee.drive
  sinew param set knee.drive.assistance=0.5
  sinew view
  sinew up my-leg.toml
  sinew reload
  sinew apps --json | jq '.apps[] | select(.ready | not)'
  sinew --socket /run/sinew/knee.sock barriers
  sinew keys init walker hip=192.168.0.11 knee=192.168.0.12 && sinew keys show
  sinew completions bash > ~/.local/share/bash-completion/completions/sinew
  sinew man ~/.local/share/man/man1";

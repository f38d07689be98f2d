//! What can be said on the command line.

use std::{path::PathBuf, time::Duration};

use clap::{CommandFactory as _, FromArgMatches as _, Parser, Subcommand};

use crate::{keys, send, watch, why};

/// Shows a running Sinew system, from any one node of it. It changes nothing, but for what `send` sends, and the files of `keys`.
///
/// It comes in through the socket of a node on this machine (`lncl.socket` in the node's configuration) and asks that node, and through
/// it all others.
#[derive(Debug, Parser)]
#[command(name = "sinew", version, after_help = AFTER)]
pub(crate) struct Arguments {
    /// The socket of a node on this machine. Without it: $SINEW_SOCKET, else the first that answers of $XDG_RUNTIME_DIR/sinew/*.sock,
    /// /run/sinew/*.sock, /tmp/sinew-*.sock; of these only one that belongs to this user or root, as does who listens there
    #[arg(long, global = true, value_name = "PATH")]
    pub(crate) socket: Option<PathBuf>,
    /// Print JSON instead of tables; where the command cannot be carried out, an object whose `fault` says why, beside the words on stderr
    #[arg(long, global = true)]
    pub(crate) json: bool,
    /// How long each node has for its answer
    #[arg(long, global = true, value_name = "MS", default_value_t = 2_000, value_parser = clap::value_parser!(u32).range(1..=60_000))]
    deadline_ms: u32,
    /// What to show
    #[command(subcommand)]
    pub(crate) command: Command,
}

/// What to show.
#[derive(Debug, Subcommand)]
pub(crate) enum Command {
    /// Every node: address, name, life, since when, for how many days its keys still count (or OPEN), what connects it, round trip and clock
    Nodes,
    /// Every application: address, name, node, ready or why not
    Apps,
    /// Who supervises whom, with lives, restarts, and how the last life ended
    Tree {
        /// A node's address or name; without it: every node
        node: Option<String>,
    },
    /// How long a message and its confirmation take
    ///
    /// The ping goes to the application's own thread, or to the node's inspection, and is answered there without the application's code.
    /// An application in a process of its own that came in through a socket answers it when it receives.
    Ping {
        /// An application's TID (127.0.0.2/80000001) or name, a node's address or name: the first that it is, in this order
        whom: String,
        /// How many, each when the one before was answered; after three in a row without an answer no more
        #[arg(long, short, default_value_t = 100, value_parser = clap::value_parser!(u32).range(1..=100_000))]
        count: u32,
    },
    /// Sends a message, and says what became of it
    ///
    /// The payload is written as MessagePack, as every typed payload is: what its type calls its fields are the keys of the JSON object.
    Send(send::Order),
    /// Shows what an application gets and sends: decoded payloads, type, class, source, age, and each type's rate once a second
    ///
    /// The copies come from the application's node, as far as it has room for them: what has none is counted, the application does not
    /// wait. Not seen is what goes over direct links between processes (`Registration::direct`). With --json each line is an object.
    Watch(watch::Order),
    /// What stands in the way between two nodes or applications: each step, seen from both ends, with what mends it
    ///
    /// All nodes are asked that can be reached through any socket of this host, so that two nodes that do not know each other are asked
    /// both. Exit code 0 if the way is free.
    Why(why::Order),
    /// Who waits for whom, at start-up barriers and at run-time ones, and who blocks them
    Barriers,
    /// Where every message is that was ever sent: what each mailbox, client and link took, and how each of these ended
    ///
    /// Each node is read twice, and both ends of each link are compared. What nobody can explain is named, with its place or link.
    Audit,
    /// Has the node that lets this command in read its access list and its deny list again, without a restart
    ///
    /// A list with faults changes nothing: each is named with its line, and the list in force stays. Connections with nodes whose
    /// certificates are on the deny list end.
    Reload,
    /// Whether this machine gives a node what it needs: interfaces, multicast, limits, real-time rights, CPU governor, clock, shared memory,
    /// sockets; whether nodes are open to others, and when their certificates end; each finding with the command that mends it
    Doctor {
        /// Interfaces that multicast is tried on, by address or by name, or `all`, with commas between them. Without it: the
        /// `ndl.interface` of the node that lets us in, else 127.0.0.1. What is sent does not leave this machine
        #[arg(long, value_name = "INTERFACE", value_delimiter = ',')]
        interface: Vec<sinew::config::Interface>,
    },
    /// Makes the keys of a whole robot, and shows who has which: its authority, and a key and a certificate for each node
    ///
    /// It asks no node. A node whose configuration names its keys takes only nodes with keys of the same project.
    #[command(subcommand)]
    Keys(keys::Order),
    /// Prints what makes the shell complete this command's words
    Completions {
        /// Which shell
        shell: clap_complete::Shell,
    },
}

/// Commands that ask no node: they have no use for what says which node, and how long it has.
const ASK_NO_NODE: [&str; 2] = ["keys", "completions"];

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
    /// What stands on the command line.
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
  0  all is fine
  1  something was found: a node does not answer or refuses, something of it does not get on, an application is not ready, a message
     was not delivered, nobody is called so; a list cannot be used; keys cannot be made, or count for less than another 30 days
  2  the command line is wrong
  3  no node lets this command in, or that node does not answer
  4  all is fine, but standard output did not take all of it (a full disk); a reader that closes its pipe, as `head`, is no error

Examples:
  sinew nodes
  sinew ping knee.drive --count 1000
  sinew send knee.drive demo.angle '{\"degrees\": 5}'
  sinew watch knee.drive --received
  sinew why hip knee.drive
  sinew reload
  sinew apps --json | jq '.apps[] | select(.ready | not)'
  sinew --socket /run/sinew/knee.sock barriers
  sinew keys init walker hip=192.168.0.11 knee=192.168.0.12 && sinew keys show
  sinew completions bash > ~/.local/share/bash-completion/completions/sinew";

//! `sinew-zenoh-bridge FILE`: lets programs that speak Zenoh exchange messages with applications of Sinew.

use std::{
    io::{self, Write as _},
    path::{Path, PathBuf},
    process::ExitCode,
};

use sinew_zenoh_bridge::bridge;
use sinew_zenoh_rules::{Config, Encoding, Get, InRoute, OutRoute};
use tracing::{error, warn};

const HELP: &str = "\
Lets programs that speak Zenoh exchange messages with applications of Sinew

Usage: sinew-zenoh-bridge [--check] FILE

Arguments:
  FILE           The configuration, a TOML file

Options:
      --check    Check the file, print its rules and their keys, and start nothing
  -h, --help     Print help
  -V, --version  Print version

The bridge is a client of one node. Nothing passes without a rule of the file:

  project = \"leg\"                    # the first part of each key
  socket = \"/run/sinew/leg.sock\"     # the node's lncl.socket
  name = \"zenoh\"                     # as the access list of the nodes knows the bridge (default)
  address = 0x2001                   # fixed address at the node, for guards of protected commands; default: any
  requests = 4                       # requests at the same time, of clients zenoh.1, zenoh.2, .. (default)
  queue = 256                        # room of each queue, in messages (default)

  [zenoh]                            # default: client of a router at tcp/127.0.0.1:7447
  mode = \"peer\"                      # or \"client\"
  connect = [\"tls/router.example:7447\"]
  listen = [\"tcp/127.0.0.1:7448\"]    # a peer only
  scouting = false                   # multicast, a peer only
  lease_ms = 2000
  tls.root_ca_certificate = \"ca.pem\" # and tls.connect_certificate, tls.connect_private_key,
                                     # tls.listen_certificate, tls.listen_private_key

  [liveness]                         # liveliness tokens of ready applications, and of nodes
  apps = [\"leg.*\"]
  nodes = true

  [[in]]                             # from Zenoh to one of: to, tid, group, broadcast = true
  to = \"knee.drive\"
  types = [\"leg.move\"]
  encoding = \"json\"                  # \"msgpack\" (default), \"json\" or \"raw\"
  class = \"control\"                  # \"control\" (default), \"stream\" or \"bulk\"
  put = true                         # a put is an unconfirmed message (default)
  get = \"ask\"                        # a get is a request (\"ask\") or a confirmed message (\"confirm\"); default: refused
  within_ms = 1000                   # for outcomes and replies (default)
  expires_after_ms = 50              # default: the message does not expire
  age_max_ms = 100                   # by Zenoh's timestamps; default: any age
  protected = { period_ms = 5 }      # the type is protected: the bridge is its sender

  [[out]]                            # from Sinew to Zenoh: messages to one of: name, group, broadcast = true
  group = \"telemetry\"
  types = [\"leg.angle\"]
  encoding = \"json\"

  [[out]]
  name = \"operator\"                  # a name of the node that a Zenoh program has
  types = [\"leg.question\"]
  token = true                       # only while it declares the token sinew/leg/@z/operator (default)
  reply = \"leg.answer\"               # the type of its replies; default: requests are refused

Keys (characters besides letters, digits, - _ . as % and two digits):
  sinew/PROJECT/n/NAME/TYPE          an application by name
  sinew/PROJECT/t/NODE/APP/TYPE      an application by address, each part 8 hexadecimal digits
  sinew/PROJECT/g/GROUP/TYPE         a group
  sinew/PROJECT/a/TYPE               all applications
  sinew/PROJECT/@/NODE               token of a node
  sinew/PROJECT/@/NODE/APP/NAME      token of an application

SIGUSR1 prints the counters, in the text format of Prometheus. SIGINT and SIGTERM end it in order. RUST_LOG sets the level of its log
(default warn,sinew_zenoh_bridge=info).

Exit codes:
  0  it was stopped in order, or the file is good
  1  it could not start, or the node does not accept it
  2  the command line or the file is wrong
";

fn main() -> ExitCode {
    zenoh::init_log_from_env_or("warn,sinew_zenoh_bridge=info");
    let arguments: Vec<_> = std::env::args_os().skip(1).collect();
    let words: Vec<_> = arguments.iter().map(|word| word.to_str().unwrap_or_default()).collect();
    match words[..] {
        ["-h" | "--help"] => print(HELP),
        ["-V" | "--version"] => print(concat!("sinew-zenoh-bridge ", env!("CARGO_PKG_VERSION"), "\n")),
        ["--check", _] => check(&PathBuf::from(&arguments[1])),
        [word] if !word.starts_with('-') => run(&PathBuf::from(&arguments[0])),
        _ => {
            error!("usage: sinew-zenoh-bridge [--check] FILE; --help explains the file");
            ExitCode::from(2)
        }
    }
}

/// Prints a text. The reader may have closed its pipe.
fn print(text: &str) -> ExitCode {
    let _ = io::stdout().write_all(text.as_bytes());
    ExitCode::SUCCESS
}

fn read(file: &Path) -> Result<Config, ExitCode> {
    Config::read(file).map_err(|why| {
        error!("{why}");
        ExitCode::from(2)
    })
}

fn check(file: &Path) -> ExitCode {
    let config = match read(file) {
        Ok(config) => config,
        Err(code) => return code,
    };
    let project = config.rules.project();
    let mut lines: Vec<_> = config.rules.inward().iter().map(|route| in_line(route, project)).collect();
    lines.extend(config.rules.outward().iter().map(|route| out_line(route, project)));
    if lines.is_empty() {
        lines.push("no rule: nothing passes\n".to_owned());
    }
    lines.extend(config.warnings.iter().map(|warning| format!("warning: {warning}\n")));
    print(&lines.concat())
}

fn in_line(route: &InRoute, project: &str) -> String {
    let put = match (&route.protection, route.allows_put) {
        (Some(_), _) => " put: protected command",
        (None, true) => " put: unconfirmed",
        (None, false) => "",
    };
    let get = match route.get {
        Some(Get::Ask) => " get: request",
        Some(Get::Confirm) => " get: confirmed",
        None => "",
    };
    format!("in   {} {}{put}{get}\n", route.address.key(project), word(route.encoding))
}

fn out_line(route: &OutRoute, project: &str) -> String {
    let reply = route.reply.as_ref().map(|(name, _)| format!(" get: reply {name}")).unwrap_or_default();
    format!("out  {} {} put{reply}\n", route.address.key(project), word(route.encoding))
}

const fn word(encoding: Encoding) -> &'static str {
    match encoding {
        Encoding::MessagePack => "msgpack",
        Encoding::Json => "json",
        Encoding::Raw => "raw",
    }
}

fn run(file: &Path) -> ExitCode {
    let config = match read(file) {
        Ok(config) => config,
        Err(code) => return code,
    };
    for warning in &config.warnings {
        warn!("{warning}");
    }
    match bridge::run(config) {
        Ok(()) => ExitCode::SUCCESS,
        Err(why) => {
            error!("{why}");
            ExitCode::FAILURE
        }
    }
}

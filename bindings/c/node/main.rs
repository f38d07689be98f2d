//! `sinew-node CONFIGURATION`: a node with no application of its own, for programs that come in through its socket.
//!
//! It prints `up` when they can connect, and stops in order at SIGINT, SIGTERM and SIGHUP. Its log is on the standard error; `SINEW_LOG` sets the
//! level (`SINEW_LOG=warn`).

use std::process::ExitCode;

use sinew::{Node, NodeConfig};

fn main() -> ExitCode {
    let mut arguments = std::env::args().skip(1);
    let (Some(path), None) = (arguments.next(), arguments.next()) else {
        eprintln!("sinew-node: give it one file, the node's configuration (docs/CONFIGURATION.md)");
        return ExitCode::FAILURE;
    };
    match start(&path) {
        Ok(node) => {
            println!("up");
            node.run()
        }
        Err(why) => {
            eprintln!("sinew-node: {why}");
            ExitCode::FAILURE
        }
    }
}

fn start(path: &str) -> Result<Node, Box<dyn std::error::Error>> {
    let config = NodeConfig::from_file(path)?;
    if config.lncl.socket.is_none() {
        return Err(format!("{path} sets no lncl.socket: no program could come in").into());
    }
    Ok(Node::builder(config.name.clone()).config(config).heed_signals().start()?)
}

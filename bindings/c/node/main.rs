//! `sinew-node CONFIGURATION`: a node with no application of its own, for programs that come in through its socket.
//!
//! It says `up` when they may come, and ends in order at SIGINT and SIGTERM. Warnings and errors are on its standard error; RUST_LOG
//! says what else is (`RUST_LOG=info`).

use std::process::ExitCode;

use sinew::{Node, NodeConfig};
use tracing_subscriber::EnvFilter;

fn main() -> ExitCode {
    let mut arguments = std::env::args().skip(1);
    let (Some(path), None) = (arguments.next(), arguments.next()) else {
        eprintln!("sinew-node: give it one file, the node's configuration (docs/CONFIGURATION.md)");
        return ExitCode::FAILURE;
    };
    let wanted = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new("warn"));
    tracing_subscriber::fmt().with_env_filter(wanted).with_writer(std::io::stderr).init();
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

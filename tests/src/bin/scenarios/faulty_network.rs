//! A network between two programs on this host that fails on command.
//!
//! `cargo run --release -p sinew-tests -- faulty_network --listen A --to B [OPTIONS]`. It reads
//! commands from its standard input, one per line, and exits at the end of the input.

use std::{io::BufRead, net::SocketAddr, process::ExitCode};

use clap::Args;
use sinew_testkit::network::{COMMANDS, FaultyNetwork, Listener, NetworkCommand, Side};

/// Forwards TCP and UDP between two programs, with the faults that its standard input commands, one per line.
///
/// The program behind `--to` is on the right side; programs that connect to `--listen` are on the left. If
/// both sides connect, configure the reverse path, too. For a Sinew node, set `gncl.announce` to this
/// address, and find the other nodes by `ndl.seeds`.
#[derive(Args)]
#[command(after_help = format!("Words: {COMMANDS}"))]
pub(super) struct Arguments {
    /// Listening address for connections to the right side.
    #[arg(long)]
    listen: SocketAddr,
    /// Destination of these connections.
    #[arg(long)]
    to: SocketAddr,
    /// Listening address for datagrams to the right side.
    #[arg(long, requires = "udp_to")]
    udp_listen: Option<SocketAddr>,
    /// Destination of these datagrams.
    #[arg(long, requires = "udp_listen")]
    udp_to: Option<SocketAddr>,
    /// Listening address for connections to the left side.
    #[arg(long, requires = "back_to")]
    back_listen: Option<SocketAddr>,
    /// Destination of these connections.
    #[arg(long, requires = "back_listen")]
    back_to: Option<SocketAddr>,
    /// Random seed.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Initial commands, each in quotes.
    #[arg(long)]
    word: Vec<NetworkCommand>,
}

pub(super) fn execute(arguments: Arguments) -> ExitCode {
    let mut listeners = vec![(Side::Right, false, arguments.listen, arguments.to)];
    listeners
        .extend(arguments.udp_listen.zip(arguments.udp_to).map(|(from, to)| (Side::Right, true, from, to)));
    listeners
        .extend(arguments.back_listen.zip(arguments.back_to).map(|(from, to)| (Side::Left, false, from, to)));
    let list: Vec<_> =
        listeners.iter().map(|&(side, datagrams, listen, _)| Listener { side, listen, datagrams }).collect();
    let network = match FaultyNetwork::start(&list, arguments.seed) {
        Ok(network) => network,
        Err(error) => {
            eprintln!("{error}");
            return ExitCode::FAILURE;
        }
    };
    for (number, (side, _, _, to)) in listeners.into_iter().enumerate() {
        network.set_destination(number, to);
        println!("{} leads to the {side:?}, to {to}", network.address(number));
    }
    arguments.word.into_iter().for_each(|word| network.execute(word));
    for line in std::io::stdin().lock().lines().map_while(Result::ok) {
        match line.parse::<NetworkCommand>() {
            Ok(word) => {
                network.execute(word);
                println!("{:?}", network.counts());
            }
            Err(error) => eprintln!("{error}"),
        }
    }
    ExitCode::SUCCESS
}

//! A network that fails on demand, between two programs on this host.
//!
//! `cargo run -p sinew-tests --bin faulty_network -- --listen A --to B [OPTIONS]`; `--help` names them. It is told what goes
//! wrong on its standard input, a word a line, and ends with it.

use std::{io::BufRead, net::SocketAddr, process::ExitCode};

use clap::Parser;
use sinew_tests::proxy::{Door, Proxy, Side, WORDS, Word};

/// Carries TCP and UDP between two programs, and lets go wrong what its standard input says, a word a line.
///
/// The program behind `--to` is on the right side, those that connect to `--listen` are on the left. Where both sides connect, name
/// the way back, too. A node of Sinew is told by `gncl.announce` that the others reach it here, and finds them by `ndl.seeds`.
#[derive(Parser)]
#[command(after_help = format!("Words: {WORDS}"))]
struct Arguments {
    /// Where connections to the right side are taken.
    #[arg(long)]
    listen: SocketAddr,
    /// Where they are carried to.
    #[arg(long)]
    to: SocketAddr,
    /// Where datagrams to the right side are taken.
    #[arg(long, requires = "udp_to")]
    udp_listen: Option<SocketAddr>,
    /// Where they are carried to.
    #[arg(long, requires = "udp_listen")]
    udp_to: Option<SocketAddr>,
    /// Where connections to the left side are taken.
    #[arg(long, requires = "back_to")]
    back_listen: Option<SocketAddr>,
    /// Where they are carried to.
    #[arg(long, requires = "back_listen")]
    back_to: Option<SocketAddr>,
    /// What all chance comes from.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Words to begin with, each in quotes.
    #[arg(long)]
    word: Vec<Word>,
}

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    let mut doors = vec![(Side::Right, false, arguments.listen, arguments.to)];
    doors.extend(arguments.udp_listen.zip(arguments.udp_to).map(|(from, to)| (Side::Right, true, from, to)));
    doors
        .extend(arguments.back_listen.zip(arguments.back_to).map(|(from, to)| (Side::Left, false, from, to)));
    let list: Vec<_> =
        doors.iter().map(|&(side, datagrams, listen, _)| Door { side, listen, datagrams }).collect();
    let proxy = match Proxy::start(&list, arguments.seed) {
        Ok(proxy) => proxy,
        Err(error) => {
            eprintln!("{error}");
            return ExitCode::FAILURE;
        }
    };
    for (number, (side, _, _, to)) in doors.into_iter().enumerate() {
        proxy.lead(number, to);
        println!("{} leads to the {side:?}, to {to}", proxy.address(number));
    }
    arguments.word.into_iter().for_each(|word| proxy.obey(word));
    for line in std::io::stdin().lock().lines().map_while(Result::ok) {
        match line.parse::<Word>() {
            Ok(word) => {
                proxy.obey(word);
                println!("{:?}", proxy.counts());
            }
            Err(error) => eprintln!("{error}"),
        }
    }
    ExitCode::SUCCESS
}

//! The role of a process that takes all client slots that it can get, and keeps them.

use std::os::unix::net::UnixStream;

use sinew::{NodeApi, Registration, client::ApiError};

use super::{commands, print_line};

/// More silent connections than a node allows.
const SILENT: usize = 300;

/// `SOCKET`: prints the number of addresses that it received, and the error at which it stopped. Then it
/// prints a line once it also has silent connections.
pub(super) fn run(arguments: &[String]) {
    let api = NodeApi::connect(&arguments[0]).expect("the node accepts clients");
    let mut addresses = Vec::new();
    let refused = loop {
        match api.register_transport_address(Registration::new()) {
            Ok(endpoint) => addresses.push(endpoint),
            Err(ApiError::Refused(words)) => break words,
            Err(error) => panic!("{error}"),
        }
    };
    print_line(&format!("has {}", addresses.len()));
    print_line(&format!("refused {refused}"));
    let silent: Vec<_> = (0..SILENT).map(|_| UnixStream::connect(&arguments[0])).collect();
    print_line(&format!("silent {}", silent.iter().filter(|one| one.is_ok()).count()));
    commands().for_each(drop);
}

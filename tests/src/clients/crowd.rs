//! The role of a process that takes all places that it can have at the door, and keeps them.

use std::os::unix::net::UnixStream;

use sinew::{NodeApi, Registration, client::ApiError};

use super::{say, told};

/// More than a node lets be silent.
const SILENT: usize = 300;

/// `SOCKET`: says how many addresses it has got, and why no more; then that it has connections besides which say nothing.
pub(super) fn play(arguments: &[String]) {
    let api = NodeApi::connect(&arguments[0]).expect("the door is open");
    let mut addresses = Vec::new();
    let refused = loop {
        match api.register_transport_address(Registration::new()) {
            Ok(endpoint) => addresses.push(endpoint),
            Err(ApiError::Refused(words)) => break words,
            Err(error) => panic!("{error}"),
        }
    };
    say(&format!("has {}", addresses.len()));
    say(&format!("refused {refused}"));
    let silent: Vec<_> = (0..SILENT).map(|_| UnixStream::connect(&arguments[0])).collect();
    say(&format!("silent {}", silent.iter().filter(|one| one.is_ok()).count()));
    told().for_each(drop);
}

//! A network between two nodes that fails on command: forwards TCP and UDP on loopback, needs no privileges.
//!
//! It connects a left and a right side. Each of its listeners leads to one side: traffic to the listener is
//! forwarded to that side's node. Faults are set for each direction separately, and can change at any time.
//!
//! | file | content |
//! | --- | --- |
//! | `faults` | the possible faults, and the commands for them |
//! | `stream` | fault logic for the bytes of a connection: no socket, no clock |
//! | `datagrams` | the same for datagrams |
//! | `listeners`, `tcp`, `udp` | the sockets |

mod datagrams;
mod faults;
mod listeners;
mod stream;
mod tcp;
#[cfg(test)]
mod tests;
mod udp;

pub use self::{
    faults::{COMMANDS, Change, Cut, Faults, NetworkCommand, Side},
    listeners::{Counts, FaultyNetwork, Listener},
};

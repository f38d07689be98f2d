//! A network between two nodes that fails on demand: forwards TCP and UDP on loopback, needs no privileges.
//!
//! It stands between a left and a right side. Each of its doors leads to one side: what connects there is carried to that
//! side's node. What goes wrong is said for each way by itself, and can be changed at any time.
//!
//! | file | what it is |
//! | --- | --- |
//! | `faults` | what can go wrong, and the words for it |
//! | `stream` | what happens to which bytes of a connection when: no socket, no clock |
//! | `datagrams` | the same for datagrams |
//! | `doors`, `tcp`, `udp` | the sockets |

mod datagrams;
mod doors;
mod faults;
mod stream;
mod tcp;
#[cfg(test)]
mod tests;
mod udp;

pub use self::{
    doors::{Counts, Door, Proxy},
    faults::{Change, Cut, Faults, Side, WORDS, Word},
};

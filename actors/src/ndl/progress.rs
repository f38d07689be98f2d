//! What of a node does not get on: written by the node about itself into its answers, read by those who watch it.

use serde::{Deserialize, Serialize};
use sinew_runtime::tid::AppAddress;

use super::Trouble;

/// Parts that are named at most: with the longest names they have 320 of a datagram's 1,200 bytes.
pub(crate) const PARTS_MAX: usize = 4;
/// Longest name of a part in bytes; a longer one is cut.
const NAME_MAX: usize = 63;

/// Layers and applications that do not get on.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Progress {
    /// How many there are, also those that are not named.
    #[serde(default)]
    pub(crate) troubled: u32,
    /// The first of them: layers, then applications by their addresses, then clients.
    #[serde(default)]
    pub(crate) parts: Vec<Part>,
}

/// A layer or an application that does not get on.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Part {
    /// Its application address.
    pub(crate) app: AppAddress,
    /// Its name.
    pub(crate) name: String,
    /// What is wrong.
    pub(crate) trouble: Told,
    /// Since when, in milliseconds before the answer.
    pub(crate) since_ms: u32,
}

/// A [`Trouble`] as a number in a datagram; one that nobody knows is the first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(from = "u8", into = "u8")]
pub(crate) struct Told(pub(crate) Trouble);

impl From<u8> for Told {
    fn from(number: u8) -> Self {
        Self(match number {
            1 => Trouble::Away,
            2 => Trouble::GivenUp,
            3 => Trouble::Unheard,
            _ => Trouble::Stalled,
        })
    }
}

impl From<Told> for u8 {
    fn from(told: Told) -> Self {
        match told.0 {
            Trouble::Stalled => 0,
            Trouble::Away => 1,
            Trouble::GivenUp => 2,
            // Said by nobody of himself.
            Trouble::Unheard => 3,
        }
    }
}

impl Progress {
    /// That of a node with these parts, of which the first are named.
    #[cfg(test)]
    pub(crate) fn of(parts: Vec<Part>) -> Self {
        Self::with_clients(parts, Vec::new())
    }

    /// That of a node with these parts of its own and these clients. A client, which anybody may start whom the node lets in, takes no
    /// place from a layer or an application of the node, whichever address it has chosen.
    pub(crate) fn with_clients(mut parts: Vec<Part>, mut clients: Vec<Part>) -> Self {
        let troubled = u32::try_from(parts.len() + clients.len()).unwrap_or(u32::MAX);
        parts.sort_by_key(|part| part.app);
        clients.sort_by_key(|part| part.app);
        parts.extend(clients);
        parts.truncate(PARTS_MAX);
        for part in &mut parts {
            let end = part.name.floor_char_boundary(NAME_MAX);
            part.name.truncate(end);
            part.name.retain(|letter| !letter.is_control());
        }
        Self { troubled, parts }
    }

    pub(crate) const fn is_nothing(&self) -> bool {
        self.troubled == 0
    }

    /// Whether it can be what a node says.
    pub(crate) fn is_fit(&self) -> bool {
        let is_fit = |part: &Part| part.name.len() <= NAME_MAX && !part.name.contains(char::is_control);
        self.parts.len() <= PARTS_MAX.min(self.troubled as usize) && self.parts.iter().all(is_fit)
    }

    /// Whether all are named.
    pub(crate) fn is_whole(&self) -> bool {
        self.troubled as usize == self.parts.len()
    }

    pub(crate) fn part(&self, app: AppAddress) -> Option<&Part> {
        self.parts.iter().find(|part| part.app == app)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn part(app: u32) -> Part {
        let name = format!("app-{app:x}");
        Part { app: AppAddress::new(app), name, trouble: Told(Trouble::Stalled), since_ms: 300 }
    }

    #[test]
    fn clients_take_no_place_from_what_is_the_nodes_own_whichever_addresses_they_have() {
        let own = || [0x9000_0000, 3].map(part).to_vec();
        let clients = || (0x1000..0x1010).rev().map(part).collect();
        let progress = Progress::with_clients(own(), clients());
        let named: Vec<_> = progress.parts.iter().map(|part| part.app.bits()).collect();
        assert_eq!((progress.troubled, &named[..]), (18, &[3, 0x9000_0000, 0x1000, 0x1001][..]));
        assert!(progress.is_fit() && !progress.is_whole());
        assert!(Progress::with_clients(own(), Vec::new()).is_whole());
    }
}

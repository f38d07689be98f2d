//! The stalled parts of a node, as it reports them to the nodes that watch it.

use std::time::Duration;

use serde::{Deserialize, Serialize};
use sinew_runtime::tid::AppAddress;

use crate::facts::Trouble;

/// Maximum number of named parts. With the longest names they take 420 of a datagram's 1,200 bytes.
pub const PARTS_MAX: usize = 4;
/// Maximum length of a part's name in bytes; a longer one is cut.
const NAME_MAX: usize = 63;
/// Maximum number of named clients. With the longest names they take 70 bytes, which fills the datagram
/// together with the parts and the longest announcement.
pub const CLIENTS_MAX: usize = 2;
/// Maximum length of a client's name in bytes; a longer one is cut.
const CLIENT_NAME_MAX: usize = 24;

/// Name of the root. The root has no address; [`AppAddress::NONE`] is used for it.
const ROOT: &str = "root";

/// The stalled layers and applications, and the idle clients. Clients are listed apart, as any admitted user
/// may start one. They take no slot of the node's own parts, regardless of their addresses and number.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Progress {
    /// Number of stalled parts, including unnamed ones.
    #[serde(default)]
    pub troubled: u32,
    /// The first of these parts: layers, then applications by their addresses.
    #[serde(default)]
    pub parts: Vec<Part>,
    /// Number of clients that do not read their pending messages, including unnamed ones. // spec: NDL-9.1
    #[serde(default, skip_serializing_if = "is_none")]
    pub idle: u32,
    /// The first of these clients, by their addresses.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub clients: Vec<IdleClient>,
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde calls it so")]
const fn is_none(count: &u32) -> bool {
    *count == 0
}

/// A client (`NodeApi`) that does not read its pending messages.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(from = "(AppAddress, String, u32)", into = "(AppAddress, String, u32)")]
pub struct IdleClient {
    /// Application address of the client.
    pub app: AppAddress,
    /// Name of the client.
    pub name: String,
    /// Minimum duration of the idle state, in milliseconds before the answer.
    pub since_ms: u32,
}

impl From<(AppAddress, String, u32)> for IdleClient {
    fn from((app, name, since_ms): (AppAddress, String, u32)) -> Self {
        Self { app, name, since_ms }
    }
}

impl From<IdleClient> for (AppAddress, String, u32) {
    fn from(IdleClient { app, name, since_ms }: IdleClient) -> Self {
        (app, name, since_ms)
    }
}

/// A stalled layer or application.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Part {
    /// Application address of the part.
    pub app: AppAddress,
    /// Name of the part.
    pub name: String,
    /// The trouble of the part.
    pub trouble: TroubleCode,
    /// Duration of the trouble, in milliseconds before the answer.
    pub since_ms: u32,
}

/// A [`Trouble`] as a number in a datagram. An unknown number is read as the first one.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(from = "u8", into = "u8")]
pub struct TroubleCode(pub Trouble);

impl From<u8> for TroubleCode {
    fn from(number: u8) -> Self {
        Self(match number {
            1 => Trouble::Down,
            2 => Trouble::GivenUp,
            3 => Trouble::Unheard,
            _ => Trouble::Stalled,
        })
    }
}

impl From<TroubleCode> for u8 {
    fn from(code: TroubleCode) -> Self {
        match code.0 {
            Trouble::Stalled => 0,
            Trouble::Down => 1,
            Trouble::GivenUp => 2,
            // A node never reports this of itself.
            Trouble::Unheard => 3,
        }
    }
}

impl Progress {
    /// Creates a report of these parts, of which the first ones are named.
    pub fn of(mut parts: Vec<Part>) -> Self {
        let troubled = u32::try_from(parts.len()).unwrap_or(u32::MAX);
        parts.sort_by_key(|part| part.app);
        parts.truncate(PARTS_MAX);
        parts.iter_mut().for_each(|part| cut(&mut part.name, NAME_MAX));
        Self { troubled, parts, ..Self::default() }
    }

    /// Adds these clients, of which the first ones are named.
    pub fn with_clients(mut self, mut clients: Vec<IdleClient>) -> Self {
        self.idle = u32::try_from(clients.len()).unwrap_or(u32::MAX);
        clients.sort_by_key(|client| client.app);
        clients.truncate(CLIENTS_MAX);
        clients.iter_mut().for_each(|client| cut(&mut client.name, CLIENT_NAME_MAX));
        Self { clients, ..self }
    }

    /// Adds that the root has not answered for `silent`. `age` is the age of the root's last report.
    #[must_use]
    pub fn with_silent_root(mut self, silent: Duration, age: Duration) -> Self {
        let millis = |time: Duration| u32::try_from(time.as_millis()).unwrap_or(u32::MAX);
        self.parts.iter_mut().for_each(|part| part.since_ms = part.since_ms.saturating_add(millis(age)));
        self.clients
            .iter_mut()
            .for_each(|client| client.since_ms = client.since_ms.saturating_add(millis(age)));
        let (app, name, trouble) = (AppAddress::NONE, ROOT.to_owned(), TroubleCode(Trouble::Stalled));
        self.parts.insert(0, Part { app, name, trouble, since_ms: millis(silent) });
        self.parts.truncate(PARTS_MAX);
        self.troubled = self.troubled.saturating_add(1);
        self
    }

    /// Returns whether no part is stalled and no client is idle.
    pub const fn is_nothing(&self) -> bool {
        self.troubled == 0 && self.idle == 0
    }

    /// Returns whether a node can have sent this report.
    pub fn is_fit(&self) -> bool {
        let are_fit = self.parts.iter().all(|part| is_fit(&part.name, NAME_MAX))
            && self.clients.iter().all(|client| is_fit(&client.name, CLIENT_NAME_MAX));
        self.parts.len() <= PARTS_MAX.min(self.troubled as usize)
            && self.clients.len() <= CLIENTS_MAX.min(self.idle as usize)
            && are_fit
    }

    /// Returns whether all stalled parts are named.
    pub fn is_whole(&self) -> bool {
        self.troubled as usize == self.parts.len()
    }

    /// Returns the named part with this address.
    pub fn part(&self, app: AppAddress) -> Option<&Part> {
        self.parts.iter().find(|part| part.app == app)
    }
}

fn cut(name: &mut String, max: usize) {
    name.truncate(name.floor_char_boundary(max));
    name.retain(|letter| !letter.is_control());
}

fn is_fit(name: &str, max: usize) -> bool {
    name.len() <= max && !name.contains(char::is_control)
}

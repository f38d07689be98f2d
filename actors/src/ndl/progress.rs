//! What of a node does not get on: written by the node about itself into its answers, read by those who watch it.

use std::time::Duration;

use serde::{Deserialize, Serialize};
use sinew_runtime::{tid::AppAddress, time::Time};

use super::Trouble;
use crate::config::NdlConfig;

/// Time between two looks of a node at itself at least.
const LOOK_MIN: Duration = Duration::from_millis(100);
/// Parts that are named at most: with the longest names they have 420 of a datagram's 1,200 bytes.
pub(crate) const PARTS_MAX: usize = 4;
/// Longest name of a part in bytes; a longer one is cut.
const NAME_MAX: usize = 63;
/// Clients that are named at most: with the longest names they have 70 bytes, with those above and the longest announcement all that there are.
pub(crate) const CLIENTS_MAX: usize = 2;
/// Longest name of a client in bytes; a longer one is cut.
const CLIENT_NAME_MAX: usize = 24;

/// Time between two looks of a node at what of it does not get on.
pub(crate) fn look_period(config: &NdlConfig) -> Duration {
    config.period.max(LOOK_MIN)
}

/// Times in a row that a node's root has not answered when it was looked at, from which on that is said.
const UNANSWERED: u32 = 3;
/// What the root is called. It has no address: [`AppAddress::NONE`] stands for one.
const ROOT: &str = "root";

/// What the root said last of what does not get on, and whether it still says anything. It may hang itself, and what it said is old then.
#[derive(Debug)]
pub(crate) struct RootWatch {
    said: Progress,
    said_at: Time,
    /// Since when it has been asked, and how often it had not answered when it was looked at.
    silent: Option<(Time, u32)>,
}

impl RootWatch {
    /// It has said nothing yet, and was not asked.
    pub(crate) fn new(now: Time) -> Self {
        Self { said: Progress::default(), said_at: now, silent: None }
    }

    /// It answered.
    pub(crate) fn answered(&mut self, now: Time, said: Progress) {
        *self = Self { said, said_at: now, silent: None };
    }

    /// It is asked, or would be if its post were not full.
    pub(crate) fn asked(&mut self, now: Time) {
        self.silent.get_or_insert((now, 0));
    }

    /// A period later it has not answered, or a further one. Looks count and not time: who got no processor himself has not looked. Returns what is
    /// to be said, if it is to be said that it does not answer. // spec: NDL-9.2
    pub(crate) fn not_answered(&mut self, now: Time) -> Option<Progress> {
        let (since, times) = self.silent.as_mut()?;
        *times = times.saturating_add(1);
        let (silent, age) = (now.since(*since), now.since(self.said_at));
        (*times >= UNANSWERED).then(|| self.said.clone().with_silent_root(silent, age))
    }
}

/// Layers and applications that do not get on, and clients that take nothing. The latter are told apart, as anybody may start one whom the
/// node lets in: they take no place from what is the node's own, whichever addresses they choose and however many they are.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Progress {
    /// How many there are, also those that are not named.
    #[serde(default)]
    pub(crate) troubled: u32,
    /// The first of them: layers, then applications by their addresses.
    #[serde(default)]
    pub(crate) parts: Vec<Part>,
    /// How many clients take nothing of what waits for them, also those that are not named. // spec: NDL-9.1
    #[serde(default, skip_serializing_if = "is_none")]
    pub(crate) idle: u32,
    /// The first of them, by their addresses.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub(crate) clients: Vec<IdleClient>,
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde calls it so")]
const fn is_none(count: &u32) -> bool {
    *count == 0
}

/// A client (`NodeApi`) that takes nothing of what waits for it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(from = "(AppAddress, String, u32)", into = "(AppAddress, String, u32)")]
pub(crate) struct IdleClient {
    /// Its application address.
    pub(crate) app: AppAddress,
    /// Its name.
    pub(crate) name: String,
    /// For how long at least, in milliseconds before the answer.
    pub(crate) since_ms: u32,
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
            1 => Trouble::Down,
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
            Trouble::Down => 1,
            Trouble::GivenUp => 2,
            // Said by nobody of himself.
            Trouble::Unheard => 3,
        }
    }
}

impl Progress {
    /// That of these parts, of which the first are named.
    pub(crate) fn of(mut parts: Vec<Part>) -> Self {
        let troubled = u32::try_from(parts.len()).unwrap_or(u32::MAX);
        parts.sort_by_key(|part| part.app);
        parts.truncate(PARTS_MAX);
        parts.iter_mut().for_each(|part| cut(&mut part.name, NAME_MAX));
        Self { troubled, parts, ..Self::default() }
    }

    /// The same with these clients, of which the first are named.
    pub(crate) fn with_clients(mut self, mut clients: Vec<IdleClient>) -> Self {
        self.idle = u32::try_from(clients.len()).unwrap_or(u32::MAX);
        clients.sort_by_key(|client| client.app);
        clients.truncate(CLIENTS_MAX);
        clients.iter_mut().for_each(|client| cut(&mut client.name, CLIENT_NAME_MAX));
        Self { clients, ..self }
    }

    /// The same, said `age` ago by a root that has not answered since it was asked, this long ago.
    fn with_silent_root(mut self, silent: Duration, age: Duration) -> Self {
        let millis = |time: Duration| u32::try_from(time.as_millis()).unwrap_or(u32::MAX);
        self.parts.iter_mut().for_each(|part| part.since_ms = part.since_ms.saturating_add(millis(age)));
        self.clients
            .iter_mut()
            .for_each(|client| client.since_ms = client.since_ms.saturating_add(millis(age)));
        let (app, name, trouble) = (AppAddress::NONE, ROOT.to_owned(), Told(Trouble::Stalled));
        self.parts.insert(0, Part { app, name, trouble, since_ms: millis(silent) });
        self.parts.truncate(PARTS_MAX);
        self.troubled = self.troubled.saturating_add(1);
        self
    }

    pub(crate) const fn is_nothing(&self) -> bool {
        self.troubled == 0 && self.idle == 0
    }

    /// Whether it can be what a node says.
    pub(crate) fn is_fit(&self) -> bool {
        let are_fit = self.parts.iter().all(|part| is_fit(&part.name, NAME_MAX))
            && self.clients.iter().all(|client| is_fit(&client.name, CLIENT_NAME_MAX));
        self.parts.len() <= PARTS_MAX.min(self.troubled as usize)
            && self.clients.len() <= CLIENTS_MAX.min(self.idle as usize)
            && are_fit
    }

    /// Whether all are named.
    pub(crate) fn is_whole(&self) -> bool {
        self.troubled as usize == self.parts.len()
    }

    pub(crate) fn part(&self, app: AppAddress) -> Option<&Part> {
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ndl::Told;

    fn part(app: u32) -> Part {
        let name = format!("app-{app:x}");
        Part { app: AppAddress::new(app), name, trouble: Told(Trouble::Stalled), since_ms: 300 }
    }

    fn client(app: u32) -> IdleClient {
        IdleClient { app: AppAddress::new(app), name: "ü".repeat(40), since_ms: 1_300 }
    }

    // spec: NDL-9.1
    #[test]
    fn clients_take_no_place_from_what_is_the_nodes_own_whichever_addresses_they_have_and_however_many() {
        let own = || Progress::of([0x9000_0000, 3, 4, 5].map(part).to_vec());
        let progress = own().with_clients((0x1000..0x9000).rev().map(client).collect());
        assert_eq!((progress.troubled, &progress.parts), (4, &own().parts));
        assert!(progress.is_fit() && progress.is_whole(), "so that it is told who gets on again");
        let named: Vec<_> = progress.clients.iter().map(|client| client.app.bits()).collect();
        assert_eq!((progress.idle, &named[..]), (0x8000, &[0x1000, 0x1001][..]));
        assert!(!Progress::default().with_clients(vec![client(1)]).is_nothing());
    }

    // spec: NDL-9.2
    #[test]
    fn a_root_that_does_not_answer_three_times_is_told_with_what_it_said_last_as_old_as_that_is() {
        let at = |ms: u64| Time::from_nanos((1_000 + ms) * 1_000_000);
        let mut root = RootWatch::new(at(0));
        let said = Progress::of((5..9).map(part).collect()).with_clients(vec![client(1)]);
        root.asked(at(0));
        root.answered(at(1), said);
        // when: it hangs, or its post is full
        root.asked(at(100));
        assert_eq!(root.not_answered(at(200)), None);
        root.asked(at(200));
        assert_eq!(root.not_answered(at(300)), None);
        let told = root.not_answered(at(401)).unwrap();
        // then
        assert!(told.is_fit() && !told.is_whole());
        let named: Vec<_> = told.parts.iter().map(|part| (part.app.bits(), part.since_ms)).collect();
        assert_eq!((told.troubled, &named[..]), (5, &[(0, 301), (5, 700), (6, 700), (7, 700)][..]));
        assert_eq!((told.parts[0].name.as_str(), told.parts[0].trouble), (ROOT, Told(Trouble::Stalled)));
        assert_eq!(told.clients[0].since_ms, 1_700);
        // and when it answers again it has three times again
        root.answered(at(500), Progress::default());
        root.asked(at(600));
        assert_eq!((root.not_answered(at(700)), root.not_answered(at(800))), (None, None));
        // One that did not look for long has not looked twice.
        root.answered(at(900), Progress::default());
        root.asked(at(1_000));
        assert_eq!(root.not_answered(at(99_000)), None);
    }

    #[test]
    fn more_clients_than_are_counted_or_with_names_that_nobody_writes_are_refused() {
        let said = Progress::default().with_clients([1, 2].map(client).to_vec());
        assert!(said.is_fit());
        let named = |name: &str| vec![IdleClient { name: name.to_owned(), ..client(1) }];
        let unfit = [
            Progress { idle: 1, ..said.clone() },
            Progress {
                idle: 9,
                clients: [1, 2, 3].map(|app| IdleClient { name: String::new(), ..client(app) }).to_vec(),
                ..Progress::default()
            },
            Progress { clients: named(&"x".repeat(25)), ..said.clone() },
            Progress { clients: named("two\nlines"), ..said },
        ];
        unfit.iter().for_each(|said| assert!(!said.is_fit(), "{said:?}"));
    }
}

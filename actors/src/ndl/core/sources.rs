//! Who says where to ask: the sources of addresses, beside each other.
//!
//! None of them says that a node is there: only an answer to a question at its address does (NDL-3.2), whoever named that. So they need not
//! trust each other, nor know of each other, and what fails of them leaves the others. What they have in common is a name, by which is
//! shown what was found through them, and a bound:
//!
//! | source | where its addresses come from | asked | bound |
//! | --- | --- | --- | --- |
//! | `seed` | the configuration, by [`Core::use_seeds`] | every period, for ever | 256 addresses |
//! | `remembered` | `memory`, by [`Input::PeersRemembered`](super::Input) | at the start, then ever more seldom | 64 addresses |
//! | `multicast` | whoever speaks in the group, or answers there | at once, then `missed_max` periods | the budget of strangers, and of candidates |
//! | `mdns` | a task of the shell, by [`Input::AddressNamed`](super::Input) | as above | as above |
//! | `query` | whoever asks this node | as above | as above |
//!
//! A further one (a directory service, a radio's own list) is a variant of [`Source`] and a task of the shell that feeds
//! [`Input::AddressNamed`](super::Input) with it, as `browse` does for mDNS; nothing else of the core knows what it is. One whose addresses are to be
//! asked for longer than a candidate's is a list in the core, as `memory` is, met in `begin` and in `use_paths`.

use std::collections::BTreeMap;

use super::Core;

/// How a node was found.
///
/// # Examples
///
/// ```
/// use sinew::discovery::Source;
///
/// let names: Vec<_> = Source::ALL.iter().map(|source| source.name()).collect();
/// assert_eq!(names.join(" "), "seed multicast mdns query remembered");
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Source {
    /// It is listed in this node's configuration.
    Seed,
    /// It spoke in the multicast group, or answered a query there.
    Multicast,
    /// Multicast DNS resolved its service.
    Mdns,
    /// It found this node first and asked it.
    Query,
    /// It was a member there before this node, or its NDL, was started anew.
    Remembered,
}

impl Source {
    /// All of them, in the order in which they are shown.
    pub const ALL: [Self; 5] = [Self::Seed, Self::Multicast, Self::Mdns, Self::Query, Self::Remembered];

    /// What it is called wherever it is shown.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Seed => "seed",
            Self::Multicast => "multicast",
            Self::Mdns => "mdns",
            Self::Query => "query",
            Self::Remembered => "remembered",
        }
    }
}

/// What a source has come to, now.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct SourceCounts {
    /// Places that it named and that are asked: an address from each of this node's that leads there.
    pub(crate) places: usize,
    /// Members that it found, perhaps beside others.
    pub(crate) members: usize,
}

impl Core {
    /// What each source has come to.
    pub(crate) fn source_counts(&self) -> BTreeMap<Source, SourceCounts> {
        let mut counts: BTreeMap<_, SourceCounts> =
            Source::ALL.map(|source| (source, SourceCounts::default())).into();
        for source in self.contacts.values().flat_map(|contact| contact.sources.keys()) {
            counts.entry(*source).or_default().places += 1;
        }
        for source in self.members.values().flat_map(|member| self.sources(member).into_keys()) {
            counts.entry(source).or_default().members += 1;
        }
        counts
    }
}

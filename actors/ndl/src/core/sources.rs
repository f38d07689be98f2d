//! The independent sources of addresses to query.
//!
//! A source never states that a node is present. Only an answer to a query to its address does (NDL-3.2),
//! from any source. So the sources need not trust or know each other, and a failed source does not affect the
//! others. Each source has a name, which is shown with the nodes found through it, and a bound:
//!
//! | source | origin of its addresses | queried | bound |
//! | --- | --- | --- | --- |
//! | `seed` | the configuration, by [`Core::use_seeds`] | every period, forever | 256 addresses |
//! | `remembered` | `memory`, by [`Input::PeersRemembered`](super::Input) | at the start, then with increasing intervals | 64 addresses |
//! | `multicast` | senders in the group, and nodes that answer there | at once, then `missed_max` periods | strangers' and candidates' budgets |
//! | `mdns` | a task of the shell, by [`Input::AddressNamed`](super::Input) | as above | as above |
//! | `query` | nodes that query this node | as above | as above |
//!
//! A new source (a directory service, a radio's own list) needs a variant of [`Source`] and a task of the
//! shell. The task feeds [`Input::AddressNamed`](super::Input), as `browse` does for mDNS. Nothing else in
//! the core depends on the kind of source. A source with addresses that are queried for longer than a candidate's
//! is a list in the core, as `memory` is. Its contacts are made in `begin` and in `use_paths`.

use std::collections::BTreeMap;

use super::Core;

/// The source that found a node.
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
    /// The node is listed in this node's configuration.
    Seed,
    /// The node sent to the multicast group, or answered a query there.
    Multicast,
    /// Multicast DNS resolved the node's service.
    Mdns,
    /// The node found this node first and queried it.
    Query,
    /// The node was a member at that address before this node, or its NDL, was restarted.
    Remembered,
}

impl Source {
    /// All sources, in their display order.
    pub const ALL: [Self; 5] = [Self::Seed, Self::Multicast, Self::Mdns, Self::Query, Self::Remembered];

    /// Returns the display name of the source.
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

/// The present results of a source.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SourceCounts {
    /// Number of places that it named and that are queried. There is one for each local address that leads to
    /// the named address.
    pub places: usize,
    /// Number of members that it found, possibly together with others.
    pub members: usize,
}

impl Core {
    /// Returns the present results of each source.
    pub fn source_counts(&self) -> BTreeMap<Source, SourceCounts> {
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

//! The order in which the node and the links are read.

use super::Direct;

/// The source of messages that is read first. The sources take turns while the inbox is full, so that a flood from one
/// does not starve the others.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Turns {
    /// Whether the links are read before the node.
    links_first: bool,
    /// The place or the index of the link that is read first.
    first_link: usize,
}

impl Direct {
    /// Returns the places of the links that report messages, in turn, if all rings of the endpoint are a set.
    pub(crate) fn ready(&self) -> Option<impl Iterator<Item = u8> + use<>> {
        let set = self.terms.options.set()?;
        set.look();
        let (first, ready) = (self.turns.first_link, set.ready());
        let is_late = move |slot: &u8| usize::from(*slot) < first;
        Some(ready.filter(move |slot| !is_late(slot)).chain(ready.filter(is_late)))
    }

    /// Returns whether the links are read before the node.
    pub(crate) const fn have_links_turn(&self) -> bool {
        self.turns.links_first
    }

    /// Lets the other of the two, the node and the links, be read first the next time: the first one has filled the
    /// inbox.
    pub(crate) const fn change_turns(&mut self) {
        self.turns.links_first = !self.turns.links_first;
    }

    /// Returns the link that is read first.
    pub(crate) const fn first_turn(&self) -> usize {
        self.turns.first_link
    }

    pub(crate) const fn set_first_turn(&mut self, link: usize) {
        self.turns.first_link = link;
    }
}

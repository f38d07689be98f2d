//! What GNCL has to tell NDL and the sync manager of connections, until they have it.
//!
//! A layer whose post is full is offered the same again in 10 ms. Meanwhile a fact takes the place of an equal one: of each life of a node
//! the last of each kind is kept, in the order in which these were said. So a layer hears that a link was down, however often it was, and
//! behind that how it is now.

use std::{collections::VecDeque, sync::Mutex};

use super::LinkFact;
use crate::{
    ndl,
    stores::{Posts, lock},
    sync,
};

/// Facts that are kept for one layer at most, for each node that may be a member: all kinds of one life.
const PER_NODE_MAX: usize = 4;

/// What is to be told to both layers, in order. It stays here while GNCL is started anew.
#[derive(Debug)]
pub(crate) struct Untold {
    ndl: Mutex<Facts>,
    sync: Mutex<Facts>,
}

#[derive(Debug)]
struct Facts {
    facts: VecDeque<LinkFact>,
    most: usize,
}

impl Untold {
    /// Nothing yet, where there are `nodes_max` members at most.
    pub(crate) fn new(nodes_max: usize) -> Self {
        let most = nodes_max.saturating_mul(PER_NODE_MAX);
        let facts = || Mutex::new(Facts { facts: VecDeque::new(), most });
        Self { ndl: facts(), sync: facts() }
    }

    /// Keeps a fact for both.
    pub(super) fn note(&self, fact: LinkFact) {
        lock(&self.ndl).note(fact.clone());
        lock(&self.sync).note(fact);
    }

    /// The links of a former instance are down until this one has them back, which the network may not let it. The sync manager, with its
    /// monitors and wills, has lived on and is told so; NDL looks for itself when it starts, which it does behind this layer.
    pub(super) fn links_are_cut(&self, broken: impl Iterator<Item = LinkFact>) {
        lock(&self.ndl)
            .facts
            .retain(|fact| !matches!(fact, LinkFact::LinkUp { .. } | LinkFact::LinkBroken { .. }));
        let mut sync = lock(&self.sync);
        broken.for_each(|fact| sync.note(fact));
    }

    /// Tells both layers what they have room for. Returns who had no room for all of it.
    pub(super) fn offer(&self, posts: &Posts) -> Option<&'static str> {
        let ndl = lock(&self.ndl).offer(|fact| posts.ndl.post(ndl::Event::Link(fact)).is_ok());
        let sync = lock(&self.sync).offer(|fact| posts.sync.post(sync::Event::Link(fact)).is_ok());
        [(ndl, "NDL"), (sync, "the sync manager")]
            .into_iter()
            .find_map(|(has_all, who)| (!has_all).then_some(who))
    }
}

impl Facts {
    fn note(&mut self, fact: LinkFact) {
        self.facts.retain(|kept| *kept != fact);
        self.facts.push_back(fact);
        if self.facts.len() > self.most {
            // More than that are of nodes that came and went meanwhile: the oldest says least.
            self.facts.pop_front();
        }
    }

    /// Offers one after the other, until one is not taken. Returns whether all were.
    fn offer(&mut self, mut takes: impl FnMut(LinkFact) -> bool) -> bool {
        while let Some(fact) = self.facts.front() {
            if !takes(fact.clone()) {
                return false;
            }
            self.facts.pop_front();
        }
        true
    }
}

#[cfg(test)]
mod tests {
    use sinew_runtime::tid::{Incarnation, NodeAddress};

    use super::*;

    const fn up(node: u32) -> LinkFact {
        LinkFact::LinkUp { node: NodeAddress::new(node), incarnation: Incarnation(1) }
    }

    const fn broken(node: u32) -> LinkFact {
        LinkFact::LinkBroken { node: NodeAddress::new(node), incarnation: Incarnation(1) }
    }

    fn kept(nodes_max: usize, facts: impl IntoIterator<Item = LinkFact>) -> Vec<LinkFact> {
        let untold = Untold::new(nodes_max);
        facts.into_iter().for_each(|fact| untold.note(fact));
        told(&untold.sync)
    }

    fn told(facts: &Mutex<Facts>) -> Vec<LinkFact> {
        let mut told = Vec::new();
        assert!(lock(facts).offer(|fact| {
            told.push(fact);
            true
        }));
        told
    }

    #[test]
    fn what_is_not_taken_is_offered_again_before_what_came_later() {
        let mut facts = Facts { facts: VecDeque::new(), most: 8 };
        facts.note(up(1));
        assert!(!facts.offer(|_| false));
        facts.note(up(2));
        let facts = Mutex::new(facts);
        assert_eq!(told(&facts), [up(1), up(2)]);
        assert_eq!(told(&facts), []);
    }

    #[test]
    fn a_layer_hears_that_a_link_was_down_and_behind_that_how_it_is_now() {
        assert_eq!(kept(8, [up(1), broken(1), up(1), broken(1), up(1)]), [broken(1), up(1)]);
        assert_eq!(kept(8, [broken(1), up(2), up(1), broken(1)]), [up(2), up(1), broken(1)]);
    }

    #[test]
    fn no_more_is_kept_than_there_is_room_for() {
        let kept = kept(2, (1..=100).flat_map(|node| [up(node), broken(node)]));
        assert_eq!(kept, (97..=100).flat_map(|node| [up(node), broken(node)]).collect::<Vec<_>>());
    }

    #[test]
    fn of_links_that_are_cut_the_sync_manager_hears_and_ndl_looks_for_itself() {
        let untold = Untold::new(8);
        let left =
            LinkFact::PeerLeft { node: NodeAddress::new(1), incarnation: Incarnation(1), gave_up: None };
        untold.note(left.clone());
        untold.note(up(2));
        untold.links_are_cut([broken(2)].into_iter());
        assert_eq!(told(&untold.ndl), std::slice::from_ref(&left));
        assert_eq!(told(&untold.sync), [left, up(2), broken(2)]);
    }
}

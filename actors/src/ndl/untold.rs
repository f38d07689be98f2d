//! What NDL has to tell GNCL and the sync manager, until they have it.
//!
//! A layer whose post is full is offered the same again in 10 ms. Meanwhile a word takes the place of what it makes out of date: of each node
//! is kept that the life is over of which the layer knows, that a later one is, and what is so now.

use std::{collections::VecDeque, sync::Mutex};

use sinew_runtime::tid::{Incarnation, NodeAddress};

use super::{MembershipFact, core::Output};
use crate::{
    gncl::Event,
    stores::{Posts, lock},
    sync,
};

/// Words that are kept for one layer at most, for each node that may be a member. Nodes that came and went meanwhile share what is left of that.
const PER_NODE_MAX: usize = 4;

/// What is to be told to both layers, in order. It stays here while NDL is started anew.
#[derive(Debug)]
pub(crate) struct Untold {
    gncl: Mutex<Words>,
    sync: Mutex<Words>,
}

#[derive(Debug)]
struct Words {
    words: VecDeque<Word>,
    most: usize,
}

#[derive(Debug)]
struct Word {
    event: Event,
    /// The layer was not told that this life was there.
    is_of_unknown: bool,
    /// The life that is over by it is fenced.
    is_fenced: bool,
}

/// What a word says of a node.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum What {
    There(Incarnation),
    Over(Incarnation),
    /// That a life of it was there bars no other.
    NoBar,
}

const fn about(event: &Event) -> Option<(NodeAddress, What)> {
    match event {
        Event::Membership(MembershipFact::NodeFound { node, incarnation, .. })
        | Event::Moved { node, incarnation, .. } => Some((*node, What::There(*incarnation))),
        Event::Membership(MembershipFact::NodeLost { node, incarnation, .. }) => {
            Some((*node, What::Over(*incarnation)))
        }
        Event::Forgotten { node, .. } => Some((*node, What::NoBar)),
        // Others say that.
        Event::DenyListChanged => None,
    }
}

impl Untold {
    /// Nothing yet, where there are `nodes_max` members at most.
    pub(crate) fn new(nodes_max: usize) -> Self {
        let words = || Mutex::new(Words::new(nodes_max));
        Self { gncl: words(), sync: words() }
    }

    /// Keeps what this order has to say to layers.
    pub(super) fn note(&self, order: &Output) {
        if let Output::Fact(fact) = order {
            lock(&self.gncl).note(Event::Membership(fact.clone()));
            lock(&self.sync).note(Event::Membership(fact.clone()));
        } else if let Output::Moved { node, incarnation, gncl } = order {
            let (node, incarnation, gncl) = (*node, *incarnation, gncl.clone());
            lock(&self.gncl).note(Event::Moved { node, incarnation, gncl });
        } else if let Output::Forgotten { node, incarnation } = order {
            lock(&self.gncl).note(Event::Forgotten { node: *node, incarnation: *incarnation });
        }
    }

    /// This life of the node is over, and fenced.
    pub(super) fn is_fenced(&self, node: NodeAddress, life: Incarnation) {
        lock(&self.gncl).is_fenced(node, life);
        lock(&self.sync).is_fenced(node, life);
    }

    /// Tells both layers what they have room for, each loss behind a `fence`, if an instance of NDL has ended between the two. Returns who had
    /// no room for all of it.
    pub(super) fn offer(&self, posts: &Posts, fence: impl Fn(&MembershipFact)) -> Option<&'static str> {
        let gncl = lock(&self.gncl).offer(&fence, |event| posts.gncl.post(event));
        let sync = lock(&self.sync).offer(&fence, |event| {
            let Event::Membership(fact) = event else { return Ok(()) };
            let told = posts.sync.post(sync::Event::Membership(fact.clone()));
            told.map_err(|_| Event::Membership(fact))
        });
        [(gncl, "GNCL"), (sync, "the sync manager")]
            .into_iter()
            .find_map(|(told, who)| told.err().map(|()| who))
    }
}

impl Words {
    fn new(nodes_max: usize) -> Self {
        Self { words: VecDeque::new(), most: nodes_max.saturating_mul(PER_NODE_MAX) }
    }

    fn note(&mut self, event: Event) {
        let Some((node, what)) = about(&event) else { return };
        let is_of_unknown = match what {
            What::There(_) => {
                let is_new = matches!(event, Event::Membership(_));
                self.drop_those(|of, what| of == node && matches!(what, What::There(_))) || is_new
            }
            What::Over(life) => {
                let is_of_unknown = self.drop_those(|of, what| (of, what) == (node, What::There(life)));
                if let Some(word) =
                    self.words.iter_mut().find(|word| about(&word.event) == Some((node, what)))
                {
                    // It was back for a while, of which the layer was not told. Why it is over now counts.
                    (word.event, word.is_fenced) = (event, false);
                    return;
                }
                if is_of_unknown {
                    self.words.retain(|word| !(word.is_of_unknown && word.is_over(node)));
                }
                is_of_unknown
            }
            What::NoBar => {
                self.drop_those(|of, what| (of, what) == (node, What::NoBar));
                false
            }
        };
        self.words.push_back(Word { event, is_of_unknown, is_fenced: false });
        if self.words.len() > self.most {
            self.make_room();
        }
    }

    /// Whether there was one among them that says a life is there of which the layer has not been told.
    fn drop_those(&mut self, is_one: impl Fn(NodeAddress, What) -> bool) -> bool {
        let mut has_unknown = false;
        self.words.retain(|word| {
            let is_kept = !about(&word.event).is_some_and(|(node, what)| is_one(node, what));
            has_unknown |= !is_kept && word.is_of_unknown;
            is_kept
        });
        has_unknown
    }

    /// So many are kept only where nodes come and go that the layer does not know: that the oldest of these is gone has to be told least.
    fn make_room(&mut self) {
        let is_gone = |word: &Word| {
            word.is_of_unknown && about(&word.event).is_some_and(|(node, _)| word.is_over(node))
        };
        let is_no_bar = |word: &Word| matches!(about(&word.event), Some((_, What::NoBar)));
        let place = self.words.iter().position(is_gone).or_else(|| self.words.iter().position(is_no_bar));
        self.words.remove(place.unwrap_or(0));
    }

    fn is_fenced(&mut self, node: NodeAddress, life: Incarnation) {
        let of_it = self.words.iter_mut().filter(|word| about(&word.event) == Some((node, What::Over(life))));
        of_it.for_each(|word| word.is_fenced = true);
    }

    /// Offers one after the other, until one is not taken.
    fn offer(
        &mut self,
        fence: impl Fn(&MembershipFact),
        mut post: impl FnMut(Event) -> Result<(), Event>,
    ) -> Result<(), ()> {
        while let Some(Word { event, is_of_unknown, is_fenced }) = self.words.pop_front() {
            if let Event::Membership(fact @ MembershipFact::NodeLost { .. }) = &event
                && !is_fenced
            {
                fence(fact);
            }
            if let Err(event) = post(event) {
                self.words.push_front(Word { event, is_of_unknown, is_fenced: true });
                return Err(());
            }
        }
        Ok(())
    }
}

impl Word {
    /// Whether it says that a life of this node is over.
    fn is_over(&self, node: NodeAddress) -> bool {
        about(&self.event).is_some_and(|(of, what)| of == node && matches!(what, What::Over(_)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ndl::LossReason;

    const NODE: NodeAddress = NodeAddress::new(7);

    fn found(node: NodeAddress, life: u64) -> Event {
        let incarnation = Incarnation(life);
        Event::Membership(MembershipFact::NodeFound { node, incarnation, gncl: Vec::new() })
    }

    fn lost(node: NodeAddress, life: u64) -> Event {
        let (incarnation, why) = (Incarnation(life), LossReason::Hung);
        Event::Membership(MembershipFact::NodeLost { node, incarnation, why })
    }

    /// A fence that nobody looks at.
    fn fenced(_: &MembershipFact) {}

    fn moved(life: u64) -> Event {
        Event::Moved { node: NODE, incarnation: Incarnation(life), gncl: Vec::new() }
    }

    fn kept(nodes_max: usize, events: impl IntoIterator<Item = Event>) -> Vec<String> {
        let mut words = Words::new(nodes_max);
        events.into_iter().for_each(|event| words.note(event));
        let mut told = Vec::new();
        words
            .offer(fenced, |event| {
                told.push(format!("{event:?}"));
                Ok(())
            })
            .unwrap();
        told
    }

    fn written<const N: usize>(events: [Event; N]) -> Vec<String> {
        events.iter().map(|event| format!("{event:?}")).collect()
    }

    #[test]
    fn what_is_not_taken_is_offered_again_before_what_came_later() {
        let mut words = Words::new(4);
        words.note(found(NODE, 1));
        assert_eq!(words.offer(fenced, Err), Err(()));
        words.note(found(NodeAddress::new(8), 1));
        let mut told = Vec::new();
        assert_eq!(
            words.offer(fenced, |event| {
                told.push(format!("{event:?}"));
                Ok(())
            }),
            Ok(())
        );
        assert_eq!(told, written([found(NODE, 1), found(NodeAddress::new(8), 1)]));
    }

    #[test]
    fn a_loss_is_fenced_once_before_it_is_offered_and_not_if_it_was() {
        let mut words = Words::new(4);
        words.note(lost(NODE, 1));
        words.note(lost(NodeAddress::new(8), 1));
        words.is_fenced(NODE, Incarnation(1));
        let done = std::cell::RefCell::new(Vec::new());
        let fence = |fact: &MembershipFact| done.borrow_mut().push(format!("fence {fact:?}"));
        let room = std::cell::Cell::new(1);
        let offer = |words: &mut Words| {
            words.offer(fence, |event| {
                done.borrow_mut().push(format!("{event:?}"));
                if room.replace(0) > 0 { Ok(()) } else { Err(event) }
            })
        };
        assert_eq!(offer(&mut words), Err(()));
        room.set(1);
        assert_eq!(offer(&mut words), Ok(()));
        let (first, second) = (format!("{:?}", lost(NODE, 1)), format!("{:?}", lost(NodeAddress::new(8), 1)));
        let Event::Membership(fact) = lost(NodeAddress::new(8), 1) else { unreachable!("it is one") };
        assert_eq!(*done.borrow(), [first, format!("fence {fact:?}"), second.clone(), second]);
    }

    #[test]
    fn the_reason_of_a_loss_is_the_last_one() {
        let (node, incarnation) = (NODE, Incarnation(5));
        let why = || LossReason::Duplicate;
        let as_duplicate = || Event::Membership(MembershipFact::NodeLost { node, incarnation, why: why() });
        let told = kept(4, [lost(NODE, 5), found(NODE, 5), as_duplicate(), found(NODE, 3)]);
        assert_eq!(told, written([as_duplicate(), found(NODE, 3)]));
    }

    #[test]
    fn the_newest_word_on_a_life_wins_and_the_end_of_each_comes_before_the_next() {
        // One that the layer knows was lost, was back and is lost: it is lost.
        assert_eq!(kept(4, [lost(NODE, 1), found(NODE, 1), lost(NODE, 1)]), written([lost(NODE, 1)]));
        assert_eq!(kept(4, [lost(NODE, 1), found(NODE, 1)]), written([lost(NODE, 1), found(NODE, 1)]));
        // Of lives that came and went the last one is kept, behind the one that the layer knows.
        let lives =
            [lost(NODE, 1), found(NODE, 2), lost(NODE, 2), found(NODE, 3), lost(NODE, 3), found(NODE, 4)];
        assert_eq!(kept(4, lives), written([lost(NODE, 1), lost(NODE, 3), found(NODE, 4)]));
        assert_eq!(kept(4, [found(NODE, 1), moved(1)]), written([moved(1)]));
        assert_eq!(kept(4, [moved(1), lost(NODE, 1)]), written([lost(NODE, 1)]));
    }

    #[test]
    fn no_more_is_kept_than_there_is_room_for_and_the_loss_of_who_is_known_always() {
        let strangers = (100..200).map(NodeAddress::new).flat_map(|node| [found(node, 1), lost(node, 1)]);
        let told = kept(1, std::iter::once(lost(NODE, 1)).chain(strangers));
        assert_eq!(told.len(), PER_NODE_MAX);
        assert_eq!(told[0], format!("{:?}", lost(NODE, 1)));
        assert_eq!(told[PER_NODE_MAX - 1], format!("{:?}", lost(NodeAddress::new(199), 1)));
    }
}

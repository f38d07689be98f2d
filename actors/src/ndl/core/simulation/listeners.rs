//! What applications are told: one of each process listens from its start on and takes all. This judge knows what the core told the other
//! layers, which the [`judge`](super::judge) has held against the world, and who has trouble.
//!
//! 1. Each find and each loss is told once, in order, of the same life, and a loss with the same class; a new life that takes a member's place is one
//!    event, `NodeRestarted`. So nobody is lost who was not found, and nobody twice.
//! 2. `AppStalled` is said of members only, of what such a life has had, and not again before `AppResumed` or with another trouble.
//! 3. When the network is well again, everybody has been told of exactly the troubles that there are.

use std::collections::{BTreeMap, VecDeque};

use sinew_runtime::tid::{AppAddress, Incarnation, NodeAddress};

use crate::ndl::{LossReason, MembershipFact, NodeEvent, Trouble};

/// What is to be told.
#[derive(Clone, Debug, PartialEq, Eq)]
enum Owed {
    Found(NodeAddress, Incarnation),
    Restarted(NodeAddress, Incarnation),
    Lost(NodeAddress, Incarnation, LossReason),
}

/// A node that is told to be there.
struct There {
    incarnation: Incarnation,
    troubles: BTreeMap<AppAddress, Trouble>,
}

/// The application of one process.
#[derive(Default)]
struct Listener {
    owed: VecDeque<Owed>,
    there: BTreeMap<NodeAddress, There>,
    /// Lives that were lost, the last of each node.
    former: BTreeMap<NodeAddress, Incarnation>,
}

/// What a life has that does not get on, and what it has had.
#[derive(Clone, Debug, Default)]
pub(super) struct Truth {
    pub(super) now: BTreeMap<AppAddress, Trouble>,
    pub(super) ever: Vec<(AppAddress, Trouble)>,
}

/// The applications of all processes, which are counted from 0.
#[derive(Default)]
pub(super) struct Listeners(Vec<Listener>);

impl Listeners {
    /// A process starts.
    pub(super) fn started(&mut self) {
        self.0.push(Listener::default());
    }

    /// A core tells the other layers.
    pub(super) fn owes(&mut self, process: usize, fact: &MembershipFact) {
        let Listener { owed, former, there } = &mut self.0[process];
        match *fact {
            MembershipFact::NodeFound { node, incarnation, .. } => {
                // The loss of the life before it is no event where the one took the other's place.
                let took_its_place = there.get(&node).is_some_and(|there| there.incarnation != incarnation)
                    && !owed.iter().any(|owed| matches!(owed, Owed::Lost(lost, ..) if *lost == node));
                let is_known = former.get(&node).is_some_and(|former| *former < incarnation);
                owed.push_back(if took_its_place || is_known {
                    Owed::Restarted(node, incarnation)
                } else {
                    Owed::Found(node, incarnation)
                });
            }
            MembershipFact::NodeLost { node, incarnation, ref why } => {
                former.insert(node, incarnation);
                if *why != LossReason::Restarted {
                    owed.push_back(Owed::Lost(node, incarnation, why.clone()));
                }
            }
        }
    }

    /// An application is told. What is wrong with that.
    pub(super) fn told(
        &mut self,
        process: usize,
        event: &NodeEvent,
        truth: impl Fn(NodeAddress, Incarnation) -> Truth,
    ) -> Result<(), String> {
        let listener = &mut self.0[process];
        match *event {
            NodeEvent::NodeFound { node, incarnation, .. } => {
                listener.pays(Owed::Found(node, incarnation))?;
                listener.there.insert(node, There { incarnation, troubles: BTreeMap::new() });
            }
            NodeEvent::NodeRestarted { node, incarnation, .. } => {
                listener.pays(Owed::Restarted(node, incarnation))?;
                listener.there.insert(node, There { incarnation, troubles: BTreeMap::new() });
            }
            NodeEvent::NodeLost { node, incarnation, ref why, .. } => {
                listener.pays(Owed::Lost(node, incarnation, why.clone()))?;
                let was_there = listener.there.remove(&node);
                if was_there.is_none_or(|there| there.incarnation != incarnation) {
                    return Err("nothing of this life was told before".to_owned());
                }
            }
            NodeEvent::AppStalled { node, app, trouble, .. } => {
                let there =
                    listener.there.get_mut(&node).ok_or("it is told to be of a node that is not there")?;
                let has_had = truth(node, there.incarnation).ever.contains(&(app.app, trouble));
                if trouble != Trouble::Unheard && !has_had {
                    return Err("it never had this trouble".to_owned());
                }
                if there.troubles.insert(app.app, trouble) == Some(trouble) {
                    return Err("this was told already".to_owned());
                }
            }
            NodeEvent::AppResumed { node, app, .. } => {
                let there =
                    listener.there.get_mut(&node).ok_or("it is told to be of a node that is not there")?;
                there.troubles.remove(&app.app).ok_or("it was not told to have any trouble")?;
            }
        }
        Ok(())
    }

    /// A core has said all that it has to say for now. What it did not tell.
    pub(super) fn all_is_told(&mut self, process: usize) -> Result<(), String> {
        let owed = &self.0[process].owed;
        if owed.is_empty() { Ok(()) } else { Err(format!("its application is not told {owed:?}")) }
    }

    /// All has been well for long. What a process was told wrong, or not at all, of a life that is there.
    pub(super) fn at_rest(&self, process: usize, node: NodeAddress, truth: &Truth) -> Result<(), String> {
        let told = self.0[process].there.get(&node).map(|there| &there.troubles);
        match told {
            None => Err(format!("its application is not told that {node} is there")),
            Some(told) if *told != truth.now => {
                Err(format!("its application is told that {node} has {told:?}, and {:?} is so", truth.now))
            }
            Some(_) => Ok(()),
        }
    }
}

impl Listener {
    fn pays(&mut self, told: Owed) -> Result<(), String> {
        match self.owed.pop_front() {
            Some(owed) if owed == told => Ok(()),
            owed => Err(format!("{owed:?} is to be told, not that")),
        }
    }
}

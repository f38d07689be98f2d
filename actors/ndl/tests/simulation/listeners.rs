//! Checks the events for applications: one application of each process subscribes at its start and accepts all. This
//! judge knows the facts that the core sent to the other layers, which the [`judge`](super::judge) has verified against
//! the world, and the true troubles.
//!
//! 1. Each find and each loss is reported once, in order, with the same incarnation, and a loss with the same class. A
//!    new incarnation that replaces a member is one event, `NodeRestarted`. So no loss is reported without a find, and
//!    none twice.
//! 2. `AppStalled` is reported only for members, and only for troubles that such an incarnation has had. It is not
//!    repeated before `AppResumed`, except with another trouble.
//! 3. When the network is healed, each application has been notified of exactly the present troubles.

use std::collections::{BTreeMap, VecDeque};

use sinew_runtime::tid::{AppAddress, Incarnation, NodeAddress};

use sinew_model::facts::{LossReason, MembershipFact, NodeEvent, Trouble};

/// An event that must be reported.
#[derive(Clone, Debug, PartialEq, Eq)]
enum Expected {
    Found(NodeAddress, Incarnation),
    Restarted(NodeAddress, Incarnation),
    Lost(NodeAddress, Incarnation, LossReason),
}

/// A node that is reported present.
struct Present {
    incarnation: Incarnation,
    troubles: BTreeMap<AppAddress, Trouble>,
}

/// The application of one process.
#[derive(Default)]
struct Listener {
    expected: VecDeque<Expected>,
    present: BTreeMap<NodeAddress, Present>,
    /// The lost incarnations, the last of each node.
    former: BTreeMap<NodeAddress, Incarnation>,
}

/// The stalled applications of an incarnation, now and ever.
#[derive(Clone, Debug, Default)]
pub(super) struct Truth {
    pub(super) now: BTreeMap<AppAddress, Trouble>,
    pub(super) ever: Vec<(AppAddress, Trouble)>,
}

/// The applications of all processes, which are counted from 0.
#[derive(Default)]
pub(super) struct Listeners(Vec<Listener>);

impl Listeners {
    /// Records the start of a process.
    pub(super) fn started(&mut self) {
        self.0.push(Listener::default());
    }

    /// Records a fact that a core sends to the other layers.
    pub(super) fn expect(&mut self, process: usize, fact: &MembershipFact) {
        let Listener { expected, former, present } = &mut self.0[process];
        match *fact {
            MembershipFact::NodeFound { node, incarnation, .. } => {
                // The loss of the previous incarnation is no event if the new one replaces it directly.
                let replaces_it =
                    present.get(&node).is_some_and(|present| present.incarnation != incarnation)
                        && !expected
                            .iter()
                            .any(|expected| matches!(expected, Expected::Lost(lost, ..) if *lost == node));
                let is_known = former.get(&node).is_some_and(|former| *former < incarnation);
                expected.push_back(if replaces_it || is_known {
                    Expected::Restarted(node, incarnation)
                } else {
                    Expected::Found(node, incarnation)
                });
            }
            MembershipFact::NodeLost { node, incarnation, ref why } => {
                former.insert(node, incarnation);
                if *why != LossReason::Restarted {
                    expected.push_back(Expected::Lost(node, incarnation, why.clone()));
                }
            }
        }
    }

    /// Checks an event for an application. Returns the violation, if any.
    pub(super) fn notified(
        &mut self,
        process: usize,
        event: &NodeEvent,
        truth: impl Fn(NodeAddress, Incarnation) -> Truth,
    ) -> Result<(), String> {
        let listener = &mut self.0[process];
        match *event {
            NodeEvent::NodeFound { node, incarnation, .. } => {
                listener.check_next(Expected::Found(node, incarnation))?;
                listener.present.insert(node, Present { incarnation, troubles: BTreeMap::new() });
            }
            NodeEvent::NodeRestarted { node, incarnation, .. } => {
                listener.check_next(Expected::Restarted(node, incarnation))?;
                listener.present.insert(node, Present { incarnation, troubles: BTreeMap::new() });
            }
            NodeEvent::NodeLost { node, incarnation, ref why, .. } => {
                listener.check_next(Expected::Lost(node, incarnation, why.clone()))?;
                let was_present = listener.present.remove(&node);
                if was_present.is_none_or(|present| present.incarnation != incarnation) {
                    return Err("no event of this incarnation was delivered before".to_owned());
                }
            }
            NodeEvent::AppStalled { node, app, trouble, .. } => {
                let present =
                    listener.present.get_mut(&node).ok_or("it is about a node that is not present")?;
                let has_had = truth(node, present.incarnation).ever.contains(&(app.app, trouble));
                if trouble != Trouble::Unheard && !has_had {
                    return Err("the application never had this trouble".to_owned());
                }
                if present.troubles.insert(app.app, trouble) == Some(trouble) {
                    return Err("it was delivered already".to_owned());
                }
            }
            NodeEvent::AppResumed { node, app, .. } => {
                let present =
                    listener.present.get_mut(&node).ok_or("it is about a node that is not present")?;
                present.troubles.remove(&app.app).ok_or("no stall of it was delivered")?;
            }
        }
        Ok(())
    }

    /// Checks, when a core has no more outputs, that no event is missing.
    pub(super) fn all_delivered(&mut self, process: usize) -> Result<(), String> {
        let expected = &self.0[process].expected;
        if expected.is_empty() {
            Ok(())
        } else {
            Err(format!("its application is not notified of {expected:?}"))
        }
    }

    /// Checks the events about a present incarnation after a long time without faults.
    pub(super) fn at_rest(&self, process: usize, node: NodeAddress, truth: &Truth) -> Result<(), String> {
        let notified = self.0[process].present.get(&node).map(|present| &present.troubles);
        match notified {
            None => Err(format!("its application is not notified that {node} is present")),
            Some(notified) if *notified != truth.now => Err(format!(
                "its application was notified that {node} has {notified:?}, and the truth is {:?}",
                truth.now
            )),
            Some(_) => Ok(()),
        }
    }
}

impl Listener {
    fn check_next(&mut self, event: Expected) -> Result<(), String> {
        match self.expected.pop_front() {
            Some(expected) if expected == event => Ok(()),
            expected => Err(format!("{expected:?} is expected instead")),
        }
    }
}

//! The inputs of a process, kept without the core's own code: why an application is not ready, as far as the
//! process can know, and which applications are reported as waiting at which barrier.

use super::*;
use sinew_sync::list::{Ended, Entry, List};

/// The state of an application in its present life.
#[derive(Default)]
struct AppState {
    /// The reason that it is not ready, if it is not.
    unready: Option<Reason>,
    phases: BTreeSet<String>,
}

impl AppState {
    /// Returns the reason that it has not reached a phase, or is not ready if no phase is given.
    /// spec: SYNC-15
    fn why_not(&self, phase: Option<&str>) -> Option<Reason> {
        let Some(phase) = phase else { return self.unready };
        let ended = self.unready.filter(|why| matches!(why, Reason::Failed | Reason::Stopped));
        (!self.phases.contains(phase)).then(|| ended.unwrap_or(Reason::NotReached))
    }
}

/// One node, by the inputs of a process.
#[derive(Default)]
struct PeerView {
    /// The incarnation that messages reach.
    linked: Option<Incarnation>,
    /// The incarnation that was linked or found last.
    present: Option<Incarnation>,
    /// The reason that it is absent, if it is.
    lost: Option<Reason>,
    /// The incarnation that was lost last and the reason, until it is found again.
    gone: Option<(Incarnation, Reason)>,
    /// The last list: its incarnation, and the state of each application in it.
    list: Option<(Incarnation, BTreeMap<String, AppState>)>,
    /// Whether a list arrived since the link came up.
    has_list: bool,
    /// The last report about barriers since the link came up.
    arrivals: Option<Arrivals>,
}

impl PeerView {
    fn link_up(&mut self, incarnation: Incarnation) {
        (self.linked, self.present, self.lost) = (Some(incarnation), Some(incarnation), None);
        self.becomes_unreachable();
    }

    fn link_broken(&mut self, incarnation: Incarnation) {
        if self.linked == Some(incarnation) {
            self.linked = None;
            // A link to a lost incarnation may come up late. It does not mean that the node is back.
            let gone = self.gone.filter(|(gone, _)| *gone == incarnation);
            self.lost = self.lost.or_else(|| gone.map(|(_, why)| why));
            self.becomes_unreachable();
        }
    }

    /// Records a loss. The first reason is kept.
    fn is_lost(&mut self, incarnation: Incarnation, why: Reason) {
        self.gone = Some((incarnation, *self.lost.get_or_insert(why)));
        self.becomes_unreachable();
    }

    /// Records that an incarnation was found. One that is earlier than the known one is accepted only when it
    /// is linked.
    fn is_found(&mut self, incarnation: Incarnation) {
        let listed =
            self.list.as_ref().map(|(listed, _)| *listed).filter(|listed| self.present == Some(*listed));
        if self.linked.or(listed).is_some_and(|known| incarnation < known) {
            return;
        }
        (self.lost, self.gone, self.present) = (None, None, Some(incarnation));
    }

    fn becomes_unreachable(&mut self) {
        (self.has_list, self.arrivals) = (false, None);
    }

    fn lists(&mut self, list: &List) {
        let state = |entry: &Entry| AppState {
            unready: match (entry.ready, entry.ended) {
                (true, _) => None,
                (false, Some(Ended::Failed)) => Some(Reason::Failed),
                (false, Some(Ended::Stopped)) => Some(Reason::Stopped),
                (false, None) => Some(Reason::NotReady),
            },
            phases: entry.phases.iter().map(ToString::to_string).collect(),
        };
        let entries = list.entries.iter().map(|entry| (entry.name.to_string(), state(entry)));
        (self.list, self.has_list) = (Some((list.incarnation, entries.collect())), true);
    }

    fn has(&self, name: &str) -> bool {
        self.list.as_ref().is_some_and(|(_, entries)| entries.contains_key(name))
    }

    /// Returns the possible reasons that a listed application is not ready, or has not reached a phase; one
    /// of these is right. // spec: SYNC-3
    fn reasons(&self, name: &str, phase: Option<&str>) -> Option<Vec<Option<Reason>>> {
        let (incarnation, entries) = self.list.as_ref()?;
        let listed = entries.get(name)?.why_not(phase);
        let reason = match self.lost {
            Some(lost) if self.present < Some(*incarnation) => {
                return Some(vec![Some(lost), Some(Reason::NodeRestarted)]);
            }
            Some(lost) => Some(lost),
            None if self.present != Some(*incarnation) => Some(Reason::NodeRestarted),
            None if self.linked.is_none() => Some(Reason::LinkDown),
            None if !self.has_list => Some(Reason::ListAwaited),
            None => listed,
        };
        Some(vec![reason])
    }

    /// Returns its report about barriers, as long as that counts. // spec: SYNC-11
    fn counted(&self) -> Option<&Arrivals> {
        let is_valid = self.linked.is_some() && self.lost.is_none() && self.has_list;
        self.arrivals.as_ref().filter(|_| is_valid)
    }
}

/// The inputs of one process.
#[derive(Default)]
pub(super) struct ProcessInputs {
    /// Its own applications by address: the name and the state of each.
    own: BTreeMap<AppAddress, (String, AppState)>,
    others: BTreeMap<NodeAddress, PeerView>,
    /// The number of openings of each barrier.
    generations: BTreeMap<String, u64>,
    /// Names that an application had while another one here waited for them: these are remembered.
    remembered: BTreeSet<String>,
    /// The same, including applications that no longer waited at the time of the check: these may be
    /// remembered.
    perhaps_remembered: BTreeSet<String>,
}

impl ProcessInputs {
    pub(super) fn record(&mut self, input: &Input) {
        match input {
            Input::AppChanged(fact) => self.app_changed(fact),
            Input::LinkChanged(fact) => self.link_changed(fact),
            Input::MembershipChanged(MembershipFact::NodeFound { node, incarnation, .. }) => {
                self.at(node).is_found(*incarnation);
            }
            Input::MembershipChanged(MembershipFact::NodeLost { node, incarnation, why }) => {
                let peer = self.at(node);
                // A duplicate that is no longer taken for the node.
                let is_another = peer.linked.is_some_and(|linked| linked != *incarnation);
                match why {
                    LossReason::Duplicate if is_another => {}
                    LossReason::Left => peer.is_lost(*incarnation, Reason::NodeLeft),
                    LossReason::GaveUp(_)
                    | LossReason::Crashed
                    | LossReason::Hung
                    | LossReason::LinkDown
                    | LossReason::Restarted
                    | LossReason::Duplicate => peer.is_lost(*incarnation, Reason::NodeLost),
                }
            }
            Input::ListReceived { from, payload } => self.at(from).lists(&List::parse(payload).unwrap()),
            Input::ArrivalsReceived { from, payload } => {
                let arrivals = Arrivals::parse(payload).unwrap();
                for barrier in &arrivals.barriers {
                    self.has_opened(&barrier.name, barrier.generation);
                }
                self.at(from).arrivals = Some(arrivals);
            }
            Input::Arrived { app, asked, .. } => self.arrives(*app, asked),
            Input::GroupsChanged(_)
            | Input::Left { .. }
            | Input::AnswerRejected { .. }
            | Input::ArrivalsRejected { .. }
            | Input::ListRejected { .. }
            | Input::DirectoryWanted { .. }
            | Input::DirectoryRejected { .. }
            | Input::ReleaseRejected { .. }
            | Input::EventRejected { .. }
            | Input::RoomMade
            | Input::TimePassed => {}
        }
    }

    fn at(&mut self, node: &NodeAddress) -> &mut PeerView {
        self.others.entry(*node).or_default()
    }

    fn app_changed(&mut self, fact: &AppFact) {
        let (app, unready) = match fact {
            AppFact::Registered { app, name, .. } => {
                let name = name.clone().expect("each has one");
                let state = AppState { unready: Some(Reason::NotReady), ..AppState::default() };
                self.own.insert(*app, (name, state));
                return;
            }
            AppFact::Unregistered { app } => return drop(self.own.remove(app)),
            AppFact::Ready { app } => (app, None),
            AppFact::Down { app } => (app, Some(Reason::Failed)),
            AppFact::Stopped { app } => (app, Some(Reason::Stopped)),
            AppFact::Handles { .. } | AppFact::Types { .. } | AppFact::GroupsChanged => return,
        };
        let state = &mut self.own.get_mut(app).expect("it is registered").1;
        state.unready = unready;
        if unready.is_some() {
            state.phases.clear();
        }
    }

    /// Records an arrival. An application that arrives at a phase has reached it.
    fn arrives(&mut self, app: AppAddress, asked: &ArriveAtBarrier) {
        if asked.kind == BarrierKind::Phase {
            let state = &mut self.own.get_mut(&app).expect("it is registered").1;
            state.phases.insert(asked.barrier.clone());
        }
    }

    fn link_changed(&mut self, fact: &LinkFact) {
        match fact {
            LinkFact::LinkUp { node, incarnation } => self.at(node).link_up(*incarnation),
            LinkFact::LinkBroken { node, incarnation } => self.at(node).link_broken(*incarnation),
            LinkFact::PeerLeft { node, incarnation, gave_up } => {
                let reason = if gave_up.is_some() { Reason::NodeLost } else { Reason::NodeLeft };
                self.at(node).is_lost(*incarnation, reason);
                self.at(node).link_broken(*incarnation);
            }
            LinkFact::DialRefused { .. } => {}
        }
    }

    /// Returns the possible reasons that the application of this name is not ready, or has not reached a
    /// phase; one of these is right. `None`: it is ready, or has reached the phase.
    pub(super) fn reasons(&self, name: &str, phase: Option<&str>) -> Vec<Option<Reason>> {
        let own = self.own.values().find(|(own, _)| own == name);
        let own = own.map(|(_, state)| vec![state.why_not(phase)]);
        let elsewhere = || self.others.values().find_map(|peer| peer.reasons(name, phase));
        own.or_else(elsewhere).unwrap_or_else(|| {
            if self.remembered.contains(name) {
                vec![Some(Reason::Unregistered)]
            } else if self.perhaps_remembered.contains(name) {
                vec![Some(Reason::Unregistered), Some(Reason::NotThere)]
            } else {
                vec![Some(Reason::NotThere)]
            }
        })
    }

    /// Returns all names that an application has, or had by the last list of its node.
    pub(super) fn names(&self) -> impl Iterator<Item = &str> {
        let elsewhere = self.others.values().filter_map(|peer| peer.list.as_ref());
        let elsewhere = elsewhere.flat_map(|(_, entries)| entries.keys());
        self.own.values().map(|(name, _)| name).chain(elsewhere).map(String::as_str)
    }

    fn has(&self, name: &str) -> bool {
        self.own.values().any(|(own, _)| own == name) || self.others.values().any(|peer| peer.has(name))
    }

    /// Sets the names that are awaited here, and those that may be; forgets all others.
    pub(super) fn remember(&mut self, awaited: BTreeSet<&str>, perhaps: BTreeSet<&str>) {
        let kept = |names: BTreeSet<&str>, before: &BTreeSet<String>| -> BTreeSet<String> {
            let kept = names.into_iter().filter(|name| before.contains(*name) || self.has(name));
            kept.map(str::to_owned).collect()
        };
        let remembered = kept(awaited, &self.remembered);
        self.perhaps_remembered = kept(perhaps, &self.perhaps_remembered);
        self.remembered = remembered;
    }

    pub(super) fn generation(&self, barrier: &str) -> u64 {
        self.generations.get(barrier).copied().unwrap_or_default()
    }

    /// Records the number of openings of a barrier.
    pub(super) fn has_opened(&mut self, barrier: &str, generation: u64) {
        let known = self.generations.entry(barrier.to_owned()).or_default();
        *known = generation.max(*known);
    }

    /// Corrects the number of openings of a barrier, as its state may have been forgotten.
    pub(super) fn correct(&mut self, barrier: &str, generation: u64) {
        self.generations.insert(barrier.to_owned(), generation);
    }

    /// Returns the applications that wait at a barrier by the reports of others, each with the generation
    /// that it waits behind.
    pub(super) fn waiting(&self, barrier: &str) -> impl Iterator<Item = (&str, u64)> {
        let published =
            self.others.values().filter_map(PeerView::counted).flat_map(|arrivals| &arrivals.barriers);
        let there = published.filter(move |one| &*one.name == barrier).flat_map(|one| &one.arrivals);
        there.map(|arrival| (arrival.name.as_deref().unwrap_or_default(), arrival.after))
    }
}

//! What a process has been told, kept without the core's means: why an application is not ready, as far as can be known there, and who is said
//! to wait where.

use super::*;
use crate::sync::list::{Ended, Entry, List};

/// How far an application has come in its present life.
#[derive(Default)]
struct Standing {
    /// Why it is not ready, if it is not.
    unready: Option<Reason>,
    phases: BTreeSet<String>,
}

impl Standing {
    /// Why it has not reached a phase, or is not ready, if none is asked for. // spec: SYNC-15
    fn why_not(&self, phase: Option<&str>) -> Option<Reason> {
        let Some(phase) = phase else { return self.unready };
        let ended = self.unready.filter(|why| matches!(why, Reason::Failed | Reason::Stopped));
        (!self.phases.contains(phase)).then(|| ended.unwrap_or(Reason::NotReached))
    }
}

/// One node, as a process has been told of it.
#[derive(Default)]
struct Sight {
    /// The life that messages reach.
    linked: Option<Incarnation>,
    /// The life that it was linked or found in last.
    present: Option<Incarnation>,
    /// Why it is not there, if it is not.
    lost: Option<Reason>,
    /// The list that came last: of which life, and how far each application in it has come.
    list: Option<(Incarnation, BTreeMap<String, Standing>)>,
    /// Whether a list came since the link did.
    has_list: bool,
    /// What it said last of barriers since the link came.
    word: Option<Arrivals>,
}

impl Sight {
    fn link_up(&mut self, life: Incarnation) {
        (self.linked, self.present, self.lost) = (Some(life), Some(life), None);
        self.falls_silent();
    }

    fn link_broken(&mut self, life: Incarnation) {
        if self.linked == Some(life) {
            self.linked = None;
            self.falls_silent();
        }
    }

    /// The first reason stays.
    fn is_lost(&mut self, why: Reason) {
        self.lost.get_or_insert(why);
        self.falls_silent();
    }

    /// An earlier life than the one that is known is taken for the node when it is linked.
    fn is_found(&mut self, life: Incarnation) {
        let listed =
            self.list.as_ref().map(|(listed, _)| *listed).filter(|listed| self.present == Some(*listed));
        if self.linked.or(listed).is_some_and(|known| life < known) {
            return;
        }
        (self.lost, self.present) = (None, Some(life));
    }

    fn falls_silent(&mut self) {
        (self.has_list, self.word) = (false, None);
    }

    fn lists(&mut self, list: &List) {
        let standing = |entry: &Entry| Standing {
            unready: match (entry.ready, entry.ended) {
                (true, _) => None,
                (false, Some(Ended::Failed)) => Some(Reason::Failed),
                (false, Some(Ended::Stopped)) => Some(Reason::Stopped),
                (false, None) => Some(Reason::NotReady),
            },
            phases: entry.phases.iter().map(ToString::to_string).collect(),
        };
        let entries = list.entries.iter().map(|entry| (entry.name.to_string(), standing(entry)));
        (self.list, self.has_list) = (Some((list.incarnation, entries.collect())), true);
    }

    fn has(&self, name: &str) -> bool {
        self.list.as_ref().is_some_and(|(_, entries)| entries.contains_key(name))
    }

    /// Why one that stands in its list is not ready, or has not reached a phase; one of these is right. // spec: SYNC-3
    fn standing(&self, name: &str, phase: Option<&str>) -> Option<Vec<Option<Reason>>> {
        let (life, entries) = self.list.as_ref()?;
        let listed = entries.get(name)?.why_not(phase);
        let standing = match self.lost {
            Some(lost) if self.present < Some(*life) => {
                return Some(vec![Some(lost), Some(Reason::NodeRestarted)]);
            }
            Some(lost) => Some(lost),
            None if self.present != Some(*life) => Some(Reason::NodeRestarted),
            None if self.linked.is_none() => Some(Reason::LinkDown),
            None if !self.has_list => Some(Reason::ListAwaited),
            None => listed,
        };
        Some(vec![standing])
    }

    /// What it says of barriers, as long as that counts. // spec: SYNC-11
    fn counted(&self) -> Option<&Arrivals> {
        let is_heard = self.linked.is_some() && self.lost.is_none() && self.has_list;
        self.word.as_ref().filter(|_| is_heard)
    }
}

/// What one process has been told.
#[derive(Default)]
pub(super) struct Told {
    /// Its own applications by address: how each is called, and how far it has come.
    own: BTreeMap<AppAddress, (String, Standing)>,
    others: BTreeMap<NodeAddress, Sight>,
    /// How often each barrier has opened.
    generations: BTreeMap<String, u64>,
    /// Names that somebody had while somebody here waited for them: those that are remembered.
    remembered: BTreeSet<String>,
    /// The same, where those count who waited no more when it was looked at: those that may be remembered.
    perhaps_remembered: BTreeSet<String>,
}

impl Told {
    pub(super) fn hears(&mut self, input: &Input) {
        match input {
            Input::AppChanged(fact) => self.app_changed(fact),
            Input::LinkChanged(fact) => self.link_changed(fact),
            Input::MembershipChanged(MembershipFact::NodeFound { node, incarnation, .. }) => {
                self.at(node).is_found(*incarnation);
            }
            Input::MembershipChanged(MembershipFact::NodeLost { node, incarnation, why }) => {
                let sight = self.at(node);
                // A double that is not taken for the node any more.
                let is_another = sight.linked.is_some_and(|linked| linked != *incarnation);
                match why {
                    LossReason::Duplicate if is_another => {}
                    LossReason::Left => sight.is_lost(Reason::NodeLeft),
                    LossReason::GaveUp(_)
                    | LossReason::Crashed
                    | LossReason::Hung
                    | LossReason::LinkDown
                    | LossReason::Restarted
                    | LossReason::Duplicate => sight.is_lost(Reason::NodeLost),
                }
            }
            Input::ListReceived { from, payload } => self.at(from).lists(&List::parse(payload).unwrap()),
            Input::ArrivalsReceived { from, payload } => {
                let word = Arrivals::parse(payload).unwrap();
                for barrier in &word.barriers {
                    self.has_opened(&barrier.name, barrier.generation);
                }
                self.at(from).word = Some(word);
            }
            Input::Arrived { app, asked, .. } => self.arrives(*app, asked),
            Input::GroupsChanged(_)
            | Input::Left { .. }
            | Input::AnswerNotTaken { .. }
            | Input::ArrivalsNotTaken { .. }
            | Input::ListNotTaken { .. }
            | Input::DirectoryWanted { .. }
            | Input::DirectoryNotTaken { .. }
            | Input::ReleaseNotTaken { .. }
            | Input::EventNotTaken { .. }
            | Input::TimePassed => {}
        }
    }

    fn at(&mut self, node: &NodeAddress) -> &mut Sight {
        self.others.entry(*node).or_default()
    }

    fn app_changed(&mut self, fact: &AppFact) {
        let (app, unready) = match fact {
            AppFact::Registered { app, name, .. } => {
                let name = name.clone().expect("each has one");
                let standing = Standing { unready: Some(Reason::NotReady), ..Standing::default() };
                self.own.insert(*app, (name, standing));
                return;
            }
            AppFact::Unregistered { app } => return drop(self.own.remove(app)),
            AppFact::Ready { app } => (app, None),
            AppFact::Down { app } => (app, Some(Reason::Failed)),
            AppFact::Stopped { app } => (app, Some(Reason::Stopped)),
            AppFact::Handles { .. } | AppFact::GroupsChanged => return,
        };
        let standing = &mut self.own.get_mut(app).expect("it is registered").1;
        standing.unready = unready;
        if unready.is_some() {
            standing.phases.clear();
        }
    }

    /// Who arrives at a phase has reached it.
    fn arrives(&mut self, app: AppAddress, asked: &ArriveAtBarrier) {
        if asked.kind == BarrierKind::Phase {
            let standing = &mut self.own.get_mut(&app).expect("it is registered").1;
            standing.phases.insert(asked.barrier.clone());
        }
    }

    fn link_changed(&mut self, fact: &LinkFact) {
        match fact {
            LinkFact::LinkUp { node, incarnation } => self.at(node).link_up(*incarnation),
            LinkFact::LinkBroken { node, incarnation } => self.at(node).link_broken(*incarnation),
            LinkFact::PeerLeft { node, incarnation, gave_up } => {
                let reason = if gave_up.is_some() { Reason::NodeLost } else { Reason::NodeLeft };
                self.at(node).is_lost(reason);
                self.at(node).link_broken(*incarnation);
            }
            LinkFact::DialRefused { .. } => {}
        }
    }

    /// Why the application of this name is not ready, or has not reached a phase; one of these is right. `None`: it is, it has.
    pub(super) fn standing(&self, name: &str, phase: Option<&str>) -> Vec<Option<Reason>> {
        let own = self.own.values().find(|(own, _)| own == name);
        let own = own.map(|(_, standing)| vec![standing.why_not(phase)]);
        let elsewhere = || self.others.values().find_map(|sight| sight.standing(name, phase));
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

    /// All names that somebody has, or had when its node was heard last.
    pub(super) fn names(&self) -> impl Iterator<Item = &str> {
        let elsewhere = self.others.values().filter_map(|sight| sight.list.as_ref());
        let elsewhere = elsewhere.flat_map(|(_, entries)| entries.keys());
        self.own.values().map(|(name, _)| name).chain(elsewhere).map(String::as_str)
    }

    fn has(&self, name: &str) -> bool {
        self.own.values().any(|(own, _)| own == name) || self.others.values().any(|sight| sight.has(name))
    }

    /// These names are waited for here, and these perhaps; others are forgotten.
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

    /// A barrier has opened so often.
    pub(super) fn has_opened(&mut self, barrier: &str, generation: u64) {
        let known = self.generations.entry(barrier.to_owned()).or_default();
        *known = generation.max(*known);
    }

    /// What was known of a barrier may have been forgotten.
    pub(super) fn correct(&mut self, barrier: &str, generation: u64) {
        self.generations.insert(barrier.to_owned(), generation);
    }

    /// Who waits at a barrier, as others say, and behind which generation.
    pub(super) fn waiting(&self, barrier: &str) -> impl Iterator<Item = (&str, u64)> {
        let said = self.others.values().filter_map(Sight::counted).flat_map(|word| &word.barriers);
        let there = said.filter(move |said| &*said.name == barrier).flat_map(|said| &said.arrivals);
        there.map(|arrival| (arrival.name.as_deref().unwrap_or_default(), arrival.after))
    }
}

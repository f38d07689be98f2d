//! The list in force, as every sender reads it; read again on request, and told who has which name.

use std::{
    collections::{BTreeSet, VecDeque},
    fmt,
    path::PathBuf,
    sync::{Arc, Mutex},
};

use arc_swap::ArcSwap;
use sinew_runtime::{
    router::guard::Guard,
    tid::{AppAddress, Incarnation, NodeAddress, Tid},
    time::Time,
    wire::{Flags, Header},
};

use super::{
    asked::Asked,
    client::{Applicant, ClientRefusal, Lines},
    file,
    index::{Index, Names},
    memberships::{JoinRefusal, Memberships},
    rule::{List, Question, Verdict},
};
use crate::{
    config::ConfigFaults,
    refusals::{BY_LIST, Refusals},
    stores::lock,
};

/// The access list of one node. It outlives the layers.
pub(crate) struct Access {
    here: NodeAddress,
    /// Where it is read from.
    path: PathBuf,
    refusals: Arc<Refusals>,
    /// SYNC: senders load it without a lock; whoever replaces it holds `writing`.
    index: ArcSwap<Index>,
    /// Of two who have the file read again, the later one reads later.
    reloading: Mutex<()>,
    /// Writers of `index` take turns.
    writing: Mutex<()>,
    /// Which user's process had which address last; of more than [`HOLDERS_MAX`] the one that came first and has gone is forgotten.
    holders: Mutex<VecDeque<Holder>>,
    /// Which applications are guests', and how many memberships of groups they have.
    memberships: Mutex<Memberships>,
    /// What the applications of this node may be told in reply.
    asked: Asked,
}

/// Nodes of which names are known at most, beyond those that the directory has.
const NODES_MAX: usize = 1_024;
/// Former holders of addresses that are known at most.
const HOLDERS_MAX: usize = 4_096;

/// An application of another process that has, or had, this address.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Holder {
    app: AppAddress,
    uid: u32,
    name: Option<String>,
    is_here: bool,
}

/// What a life of a node has said of who is called how in it.
#[derive(Clone, Debug)]
pub(crate) struct Said<'a> {
    pub(crate) node: NodeAddress,
    pub(crate) life: Incarnation,
    pub(crate) names: Vec<(AppAddress, &'a str)>,
}

/// An access list that was read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct AccessSummary {
    /// Its rules for messages.
    pub rules: usize,
    /// Its rules for users of this host.
    pub clients: usize,
}

/// Why a node goes on with the access list that it has. The file is at fault, or whoever asks; nothing changed.
#[derive(Debug, thiserror::Error)]
pub enum AccessError {
    /// The node was started without a list.
    #[error("this node has no access list: set security.access, and start it again")]
    None,
    /// The file cannot be used; all that is wrong with it is listed. The list that was in force still is.
    #[error("the access list {path:?} cannot be used, and the one in force stays:\n{faults}")]
    Faults {
        /// The file.
        path: PathBuf,
        /// All of them.
        faults: ConfigFaults,
    },
}

/// What the list in force says of a message, and why.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Explanation {
    pub(crate) is_allowed: bool,
    /// The rule that counts, or that there is none, with the names that it was looked up for.
    pub(crate) why: String,
}

impl Access {
    /// The `list` that was read from `path`, in force on the node at `here`.
    pub(crate) fn new(here: NodeAddress, path: PathBuf, list: List, refusals: Arc<Refusals>) -> Self {
        let index = ArcSwap::from_pointee(Index::new(Arc::new(list), here));
        let (reloading, writing, holders) = (Mutex::default(), Mutex::default(), Mutex::default());
        let (memberships, asked) = (Mutex::default(), Asked::default());
        Self { here, path, refusals, index, reloading, writing, holders, memberships, asked }
    }

    /// Reads the file again and puts its list in force, for every message from now on.
    ///
    /// # Errors
    /// It cannot be used; the list in force stays.
    pub(crate) fn reload(&self) -> Result<AccessSummary, AccessError> {
        let _turn = lock(&self.reloading);
        let read = file::read(&self.path);
        let list = read.map_err(|faults| AccessError::Faults { path: self.path.clone(), faults })?;
        self.put_in_force(list);
        Ok(self.summary())
    }

    pub(super) fn put_in_force(&self, list: List) {
        let _turn = lock(&self.writing);
        self.index.store(Arc::new(self.index.load().with_list(Arc::new(list))));
    }

    pub(crate) fn summary(&self) -> AccessSummary {
        let index = self.index.load();
        AccessSummary { rules: index.list.rules.len(), clients: index.list.clients.len() }
    }

    /// Whether users beside the node's own and root may come in.
    pub(crate) fn has_clients(&self) -> bool {
        !self.index.load().list.clients.is_empty()
    }

    /// An application of this node has come; said before it can send or get anything.
    pub(crate) fn named(&self, app: AppAddress, name: Option<&str>) {
        let Some(name) = name else { return };
        self.change(self.here, |index, names| {
            let known = index.look(Tid::new(self.here, app), name);
            Arc::make_mut(&mut names.apps).insert(app, known);
        });
    }

    /// An application of this node has gone for good.
    pub(crate) fn gone(&self, app: AppAddress) {
        self.asked.forget(app);
        lock(&self.memberships).gone(app);
        lock(&self.holders)
            .iter_mut()
            .filter(|holder| holder.app == app)
            .for_each(|holder| holder.is_here = false);
        if self.index.load().name_of(Tid::new(self.here, app)).is_some() {
            self.change(self.here, |_, names| drop(Arc::make_mut(&mut names.apps).remove(&app)));
        }
    }

    fn change(&self, node: NodeAddress, edit: impl FnOnce(&Index, &mut Names)) {
        let _turn = lock(&self.writing);
        let index = self.index.load();
        let mut names = index.names_on(node);
        edit(&index, &mut names);
        self.index.store(Arc::new(index.with_names(node, names)));
    }

    /// A connection to this life of `node` begins; said before anything of it is taken. What a life before has called its applications is
    /// not what this one does: its addresses are given out anew.
    pub(crate) fn meets(&self, node: NodeAddress, life: Incarnation) {
        if self.index.load().nodes.get(&node).is_some_and(|names| names.life == Some(life)) {
            return;
        }
        self.change(node, |_, names| {
            let apps = std::mem::take(&mut names.apps);
            let former = names.life.filter(|_| names.is_told).map(|life| (life, apps));
            *names = Names { life: Some(life), former, ..Names::default() };
        });
        self.make_room(node);
    }

    /// Forgets nodes that have said nothing, where they are many; but not `met`.
    fn make_room(&self, met: NodeAddress) {
        let _turn = lock(&self.writing);
        let index = self.index.load();
        if index.nodes.len() > NODES_MAX {
            let mut index = Index::clone(&index);
            index.nodes.retain(|node, names| names.is_told || [self.here, met].contains(node));
            self.index.store(Arc::new(index));
        }
    }

    /// These have names on other nodes, or on the one that is given, as those have said; nobody else there has one. What a life has said
    /// that is not the one that was met counts for nobody.
    pub(crate) fn named_elsewhere<'a>(
        &self,
        node: Option<NodeAddress>,
        told: impl Iterator<Item = Said<'a>>,
    ) {
        let is_meant = |of: NodeAddress| of != self.here && node.is_none_or(|node| of == node);
        let _turn = lock(&self.writing);
        let former = self.index.load();
        let mut index = Index::clone(&former);
        let mut silent: Vec<_> = index
            .nodes
            .iter()
            .filter(|(of, names)| is_meant(**of) && names.is_told)
            .map(|(of, _)| *of)
            .collect();
        for Said { node, life, names } in told.filter(|said| is_meant(said.node)) {
            let before = former.names_on(node);
            if before.life.is_some_and(|met| met != life) {
                continue;
            }
            silent.retain(|of| *of != node);
            let apps = former.look_all(node, names.into_iter(), &before.apps);
            index.nodes.insert(node, Arc::new(Names { life: Some(life), is_told: true, apps, ..before }));
        }
        for node in silent {
            let before = former.names_on(node);
            let names = Names { is_told: false, apps: Arc::default(), ..before };
            index.nodes.insert(node, Arc::new(names));
        }
        self.index.store(Arc::new(index));
    }

    /// By what a last will is judged that an application of this life of `node` has left; `None`: as any message.
    pub(crate) fn of_life(&self, node: NodeAddress, life: Incarnation) -> Option<Arc<dyn Guard>> {
        let index = self.index.load();
        let known = index.names_on(node);
        if known.life.is_none_or(|known| known == life) {
            return None;
        }
        let former = known.former.filter(|(former, _)| *former == life);
        let names = Names { life: Some(life), is_told: former.is_some(), ..Names::default() };
        let names = Names { apps: former.map(|(_, apps)| apps).unwrap_or_default(), ..names };
        let (index, refusals) = (index.with_names(node, names), self.refusals.clone());
        Some(Arc::new(OfLife { here: self.here, index, refusals }))
    }

    /// A process of `uid` has this address.
    pub(crate) fn holds(&self, app: AppAddress, uid: u32, name: Option<&str>) {
        let mut holders = lock(&self.holders);
        holders.retain(|holder| holder.app != app);
        if holders.len() >= HOLDERS_MAX {
            // Who is here stays: of these there are `lncl.clients_max`, which is no more than this, and by them it is known who is one of the robot's own.
            let first = holders.iter().position(|holder| !holder.is_here).unwrap_or(0);
            holders.remove(first);
        }
        holders.push_back(Holder { app, uid, name: name.map(str::to_owned), is_here: true });
    }

    /// Whether the last one that had this address was the same user under the same name: other nodes may still call it so.
    pub(crate) fn has_held(&self, app: AppAddress, uid: u32, name: Option<&str>) -> bool {
        let is_it = |holder: &Holder| (holder.app, holder.uid, holder.name.as_deref()) == (app, uid, name);
        lock(&self.holders).iter().any(is_it)
    }

    /// Whether a process of this host may come in.
    pub(crate) fn admit(&self, own: u32, who: Applicant) -> Result<(), ClientRefusal> {
        self.index.load().list.admit(own, who)
    }

    /// Whether a process of this host may register so.
    pub(crate) fn may_register(
        &self,
        own: u32,
        who: Applicant,
        name: Option<&str>,
        address: Option<AppAddress>,
    ) -> Result<(), ClientRefusal> {
        self.index.load().list.may_register(own, who, name, address)
    }

    /// A guest, of `uid`, has this address; said before it can join or ask anything.
    pub(crate) fn guest_came(&self, app: AppAddress, uid: u32) {
        self.asked.guest_came(app, uid);
        lock(&self.memberships).came(app, uid);
    }

    /// One of the robot's own has this address; said before it can join or ask anything.
    pub(crate) fn own_came(&self, app: AppAddress) {
        self.asked.forget(app);
        lock(&self.memberships).gone(app);
    }

    /// The applications of guests: of users beside the node's own and root.
    pub(crate) fn guests(&self) -> BTreeSet<AppAddress> {
        lock(&self.memberships).guests()
    }

    /// Counts that `who`, the application at `app`, becomes a member of `group`, if it may by the list in force now. What it is a member of
    /// already it stays, whatever list comes.
    pub(crate) fn join(
        &self,
        own: u32,
        (who, app): (Applicant, AppAddress),
        group: AppAddress,
    ) -> Result<(), JoinRefusal> {
        self.index.load().list.may_join(own, who, group)?;
        lock(&self.memberships).join(app)
    }

    /// It is not a member any more of a group that it had joined.
    pub(crate) fn leave(&self, app: AppAddress) {
        lock(&self.memberships).leave(app);
    }

    /// Whether the process that has this address now is one of the user `own`, or of root; not, if that is not known any more.
    pub(crate) fn is_of(&self, app: AppAddress, own: u32) -> bool {
        lock(&self.holders).iter().any(|holder| holder.app == app && [own, 0].contains(&holder.uid))
    }

    /// Whether a rule is about processes of the user `own` in its group, of whom most are meant to do anything.
    pub(crate) fn narrows(&self, own: Applicant) -> bool {
        self.index.load().list.is_about(own)
    }

    /// Where the rules are that let users beside `own` and root in and name no groups, if there are any.
    pub(crate) fn without_groups(&self, own: u32) -> Option<Lines> {
        self.index.load().list.without_groups(own)
    }

    /// The groups that rules name: of a message to any other one the list says what it says of one to its members alone.
    pub(crate) fn groups_in_rules(&self) -> BTreeSet<AppAddress> {
        self.index.load().list.rules.iter().flat_map(|rule| rule.groups.iter().copied()).collect()
    }

    /// What becomes of such a message, and why.
    pub(crate) fn explain(&self, asked: Question) -> Explanation {
        explained(&self.index.load(), asked)
    }
}

fn explained(index: &Index, asked: Question) -> Explanation {
    let (is_allowed, rule) = match index.decide(asked) {
        Verdict::Allowed(rule) => (true, Some(rule)),
        Verdict::Refused(rule) => (false, rule),
    };
    let label = |tid: Tid| Label(tid, index.name_of(tid).map(str::to_owned));
    let (source, target) = (label(asked.source), label(asked.target));
    let rule = index.list.in_words(rule);
    Explanation { is_allowed, why: format!("{rule}, for {source} to {target}") }
}

fn judge(index: &Index, refusals: &Refusals, asked: Question, is_for_one: bool) -> bool {
    let Verdict::Refused(rule) = index.decide(asked) else { return true };
    // That no rule is about one of many to whom something goes is how a list is meant to be: nothing to be told of.
    if (is_for_one || rule.is_some()) && refusals.logs_by_list(Time::now()) {
        refusals.count(Time::now(), BY_LIST, &Refused(index, asked));
    } else {
        refusals.count_by_list();
    }
    false
}

/// What is asked of the list for a message to the application of the node at `here`.
fn question(here: NodeAddress, header: &Header, app: AppAddress) -> Question {
    let destination = header.destination.app;
    Question {
        source: header.source,
        target: Tid::new(here, app),
        group: destination.is_group().then_some(destination),
        class: header.class,
    }
}

/// The list with the names of another life of a node.
struct OfLife {
    here: NodeAddress,
    index: Index,
    refusals: Arc<Refusals>,
}

impl Guard for OfLife {
    fn allows(&self, header: &Header, app: AppAddress) -> bool {
        judge(&self.index, &self.refusals, question(self.here, header, app), header.destination.is_single())
    }

    /// What it judges was sent by another node.
    fn asks(&self, _: &Header) {}
}

impl Guard for Access {
    fn allows(&self, header: &Header, app: AppAddress) -> bool {
        // What the layers of this node tell its applications; nobody else can have such a source here.
        if header.source.node == self.here && header.source.app.is_layer() {
            return true;
        }
        if header.flags.has(Flags::REPLY)
            && header.destination.is_single()
            && self.asked.take(Time::now(), header, app)
        {
            return true;
        }
        judge(
            &self.index.load(),
            &self.refusals,
            question(self.here, header, app),
            header.destination.is_single(),
        )
    }

    fn asks(&self, header: &Header) {
        // What the node's own layers reply needs no leave.
        if header.destination.node != self.here || !header.destination.app.is_layer() {
            self.asked.note(Time::now(), header);
        }
    }
}

/// Put into words only where it is logged.
struct Refused<'a>(&'a Index, Question);

impl fmt::Display for Refused<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self(index, asked) = self;
        write!(f, "{} in class {:?}", explained(index, *asked).why, asked.class)
    }
}

/// An application as people call it.
struct Label(Tid, Option<String>);

impl fmt::Display for Label {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self(tid, Some(name)) => write!(f, "'{name}' at {tid}"),
            Self(tid, None) => write!(f, "{tid}, which has no name in this node's directory"),
        }
    }
}

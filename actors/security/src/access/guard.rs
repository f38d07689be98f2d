//! The active access list as every sender reads it. It can be reloaded, and receives the names in the directory.

mod participants;
mod roles;

use std::{
    collections::{BTreeSet, VecDeque},
    fmt,
    path::{Path, PathBuf},
    sync::{Arc, Mutex},
};

use arc_swap::ArcSwap;
use sinew_model::{
    config::ConfigError,
    refusals::{BY_LIST, Refusals},
};
use sinew_runtime::{
    lock,
    parameters::{ParameterVote, SetParameters},
    router::guard::Guard,
    tid::{AppAddress, Incarnation, NodeAddress, Tid},
    time::Time,
    wire::{Flags, Header, Message, Payload},
};

use self::participants::Participants;
use super::{
    client::{Applicant, ClientAccessError, Lines},
    file,
    index::{Index, Names},
    memberships::{JoinGroupError, Memberships},
    pending_requests::PendingRequests,
    rule::{List, Question, Verdict},
};

/// The access list of one node. It outlives the layers.
pub struct Access {
    here: NodeAddress,
    /// Path of the list's file.
    path: PathBuf,
    refusals: Arc<Refusals>,
    /// SYNC: senders load it without a lock; a writer holds `writing` while it replaces the index.
    index: ArcSwap<Index>,
    /// Serializes reloads, so that the reload that started later reads the file later.
    reloading: Mutex<()>,
    /// Serializes writers of `index`.
    writing: Mutex<()>,
    /// The user of the latest process of each address. Beyond [`HOLDERS_MAX`] entries, the oldest entry of an ended
    /// process is evicted.
    holders: Mutex<VecDeque<Holder>>,
    /// The guests' applications and the number of their group memberships.
    memberships: Mutex<Memberships>,
    /// Pending requests of this node's applications: their replies need no rule.
    pending: PendingRequests,
    /// The participants of transactions of parameters: their messages need no rule.
    participants: Participants,
}

/// Maximum number of nodes with known names, in addition to those in the directory.
const NODES_MAX: usize = 1_024;
/// Maximum number of remembered holders of addresses.
const HOLDERS_MAX: usize = 4_096;

/// An application of another process that has or had this address.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Holder {
    app: AppAddress,
    uid: u32,
    name: Option<String>,
    is_here: bool,
}

/// The names of applications that one incarnation of a node reported.
#[derive(Clone, Debug)]
pub struct ReportedNames<'a> {
    /// The node.
    pub node: NodeAddress,
    /// Its incarnation.
    pub incarnation: Incarnation,
    /// Each application with a name.
    pub names: Vec<(AppAddress, &'a str)>,
}

/// The summary of an access list that was read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct AccessSummary {
    /// Number of rules for messages.
    pub rules: usize,
    /// Number of rules for users of this host.
    pub clients: usize,
}

/// The reason why a node keeps its current access list. The file or the caller is at fault; nothing changed.
#[derive(Debug, thiserror::Error)]
pub enum AccessError {
    /// The node was started without a list.
    #[error("this node has no access list: set security.access, and start it again")]
    None,
    /// The file cannot be used, and all its faults are listed. The previous list stays in force.
    #[error("the access list {path:?} cannot be used, and the one in force stays:\n{faults}")]
    Faults {
        /// Path of the file.
        path: PathBuf,
        /// All faults of the file.
        faults: ConfigError,
    },
}

/// The decision of the active list for a message, and its reason.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Explanation {
    /// Whether the message may be delivered.
    pub is_allowed: bool,
    /// The deciding rule, or that there is none, with the names used in the look-up.
    pub why: String,
}

#[cfg(any(test, feature = "testing"))]
impl Access {
    /// Returns a list without a file, for tests.
    ///
    /// # Panics
    /// If the text has a fault.
    #[must_use]
    pub fn in_test(node: NodeAddress, refusals: &Arc<Refusals>, text: &str) -> Arc<Self> {
        let list = file::parse(text).unwrap_or_else(|faults| panic!("{faults}"));
        Arc::new(Self::new(node, "nowhere".into(), list, refusals.clone()))
    }

    /// Replaces the list, as a reload of its file does.
    ///
    /// # Panics
    /// If the text has a fault.
    pub fn replace_in_test(&self, text: &str) {
        self.activate(file::parse(text).unwrap_or_else(|faults| panic!("{faults}")));
    }
}

impl Access {
    /// Puts the `list` that was read from `path` in force on the node at `here`.
    pub fn new(here: NodeAddress, path: PathBuf, list: List, refusals: Arc<Refusals>) -> Self {
        let index = ArcSwap::from_pointee(Index::new(Arc::new(list), here));
        let (reloading, writing, holders) = (Mutex::default(), Mutex::default(), Mutex::default());
        let (memberships, pending) = (Mutex::default(), PendingRequests::default());
        let participants = Participants::default();
        Self { here, path, refusals, index, reloading, writing, holders, memberships, pending, participants }
    }

    /// Reads the file again and puts its list in force for all later messages.
    ///
    /// # Errors
    /// Returns the faults of the file. The active list stays in force.
    pub fn reload(&self) -> Result<AccessSummary, AccessError> {
        let _turn = lock(&self.reloading);
        let read = file::read(&self.path);
        let list = read.map_err(|faults| AccessError::Faults { path: self.path.clone(), faults })?;
        self.activate(list);
        Ok(self.summary())
    }

    pub(super) fn activate(&self, list: List) {
        let _turn = lock(&self.writing);
        self.index.store(Arc::new(self.index.load().with_list(Arc::new(list))));
    }

    /// Returns the path of the list's file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Returns how much the active list has.
    pub fn summary(&self) -> AccessSummary {
        let index = self.index.load();
        AccessSummary { rules: index.list.rules.len(), clients: index.list.clients.len() }
    }

    /// Returns whether users other than the node's own user and root may connect.
    pub fn has_clients(&self) -> bool {
        !self.index.load().list.clients.is_empty()
    }

    /// Registers the name of an application of this node. Called before the application can send or receive anything.
    pub fn named(&self, app: AppAddress, name: Option<&str>) {
        let Some(name) = name else { return };
        self.change(self.here, |index, names| {
            let known = index.match_rules(Tid::new(self.here, app), name);
            Arc::make_mut(&mut names.apps).insert(app, known);
        });
    }

    /// Removes an application of this node.
    pub fn remove(&self, app: AppAddress) {
        self.pending.forget(app);
        lock(&self.memberships).remove(app);
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

    /// Registers the incarnation of `node` of a new connection. Called before anything is received on that connection.
    /// Names of an earlier incarnation do not apply to this one, because its addresses are assigned anew.
    pub fn on_connected(&self, node: NodeAddress, incarnation: Incarnation) {
        if self.index.load().nodes.get(&node).is_some_and(|names| names.incarnation == Some(incarnation)) {
            return;
        }
        self.change(node, |_, names| {
            let apps = std::mem::take(&mut names.apps);
            let former =
                names.incarnation.filter(|_| names.is_reported).map(|incarnation| (incarnation, apps));
            *names = Names { incarnation: Some(incarnation), former, ..Names::default() };
        });
        self.make_room(node);
    }

    /// Evicts nodes that have reported no names when there are too many, except `kept`.
    fn make_room(&self, kept: NodeAddress) {
        let _turn = lock(&self.writing);
        let index = self.index.load();
        if index.nodes.len() > NODES_MAX {
            let mut index = Index::clone(&index);
            index.nodes.retain(|node, names| names.is_reported || [self.here, kept].contains(node));
            self.index.store(Arc::new(index));
        }
    }

    /// Replaces the names on all other nodes, or on the given one, by the reported ones. Other applications there have
    /// no name. Reports of an incarnation other than the connected one are ignored.
    pub fn set_remote_names<'a>(
        &self,
        node: Option<NodeAddress>,
        reports: impl Iterator<Item = ReportedNames<'a>>,
    ) {
        let is_target = |of: NodeAddress| of != self.here && node.is_none_or(|node| of == node);
        let _turn = lock(&self.writing);
        let former = self.index.load();
        let mut index = Index::clone(&former);
        let mut silent: Vec<_> = index
            .nodes
            .iter()
            .filter(|(of, names)| is_target(**of) && names.is_reported)
            .map(|(of, _)| *of)
            .collect();
        for ReportedNames { node, incarnation, names } in reports.filter(|report| is_target(report.node)) {
            let before = former.names_on(node);
            if before.incarnation.is_some_and(|connected| connected != incarnation) {
                continue;
            }
            silent.retain(|of| *of != node);
            let apps = former.match_all(node, names.into_iter(), &before.apps);
            index.nodes.insert(
                node,
                Arc::new(Names { incarnation: Some(incarnation), is_reported: true, apps, ..before }),
            );
        }
        for node in silent {
            let before = former.names_on(node);
            let names = Names { is_reported: false, apps: Arc::default(), ..before };
            index.nodes.insert(node, Arc::new(names));
        }
        self.index.store(Arc::new(index));
    }

    /// Returns the guard for a last will of an application of this incarnation of `node`. `None`: the will is judged as
    /// any other message.
    pub fn guard_for(&self, node: NodeAddress, incarnation: Incarnation) -> Option<Arc<dyn Guard>> {
        let index = self.index.load();
        let known = index.names_on(node);
        if known.incarnation.is_none_or(|known| known == incarnation) {
            return None;
        }
        let former = known.former.filter(|(former, _)| *former == incarnation);
        let names =
            Names { incarnation: Some(incarnation), is_reported: former.is_some(), ..Names::default() };
        let names = Names { apps: former.map(|(_, apps)| apps).unwrap_or_default(), ..names };
        let (index, refusals) = (index.with_names(node, names), self.refusals.clone());
        Some(Arc::new(IncarnationGuard { here: self.here, index, refusals }))
    }

    /// Records that a process of `uid` holds this address.
    pub fn holds(&self, app: AppAddress, uid: u32, name: Option<&str>) {
        let mut holders = lock(&self.holders);
        holders.retain(|holder| holder.app != app);
        if holders.len() >= HOLDERS_MAX {
            // Entries of present processes stay: there are at most `lncl.clients_max` of them, which is at most
            // `HOLDERS_MAX`. They also identify the robot's own applications.
            let first = holders.iter().position(|holder| !holder.is_here).unwrap_or(0);
            holders.remove(first);
        }
        holders.push_back(Holder { app, uid, name: name.map(str::to_owned), is_here: true });
    }

    /// Returns whether the last holder of this address was the same user with the same name. Other nodes may still use
    /// that name for it.
    pub fn has_held(&self, app: AppAddress, uid: u32, name: Option<&str>) -> bool {
        let is_it = |holder: &Holder| (holder.app, holder.uid, holder.name.as_deref()) == (app, uid, name);
        lock(&self.holders).iter().any(is_it)
    }

    /// Checks whether a process of this host may connect.
    pub fn admit(&self, own: u32, applicant: Applicant) -> Result<(), ClientAccessError> {
        self.index.load().list.admit(own, applicant)
    }

    /// Checks whether a process of this host may register with this name and address.
    pub fn may_register(
        &self,
        own: u32,
        applicant: Applicant,
        name: Option<&str>,
        address: Option<AppAddress>,
    ) -> Result<(), ClientAccessError> {
        self.index.load().list.may_register(own, applicant, name, address)
    }

    /// Registers a guest of `uid` at this address. Called before the guest can join a group or send a request.
    pub fn add_guest(&self, app: AppAddress, uid: u32) {
        self.pending.add_guest(app, uid);
        lock(&self.memberships).add_guest(app, uid);
    }

    /// Registers one of the robot's own applications at this address. Called before it can join a group or send a
    /// request.
    pub fn add_own(&self, app: AppAddress) {
        self.pending.forget(app);
        lock(&self.memberships).remove(app);
    }

    /// Returns the applications of guests: of users other than the node's own user and root.
    pub fn guests(&self) -> BTreeSet<AppAddress> {
        lock(&self.memberships).guests()
    }

    /// Adds the membership of the application at `app` in `group` if the active list allows it. A reloaded list does
    /// not end existing memberships.
    pub fn join(
        &self,
        own: u32,
        (applicant, app): (Applicant, AppAddress),
        group: AppAddress,
    ) -> Result<(), JoinGroupError> {
        self.index.load().list.may_join(own, applicant, group)?;
        lock(&self.memberships).join(app)
    }

    /// Counts one membership of the application less.
    pub fn leave(&self, app: AppAddress) {
        lock(&self.memberships).leave(app);
    }

    /// Returns whether the process with this address runs as the user `own` or root. Returns `false` if this is no
    /// longer known.
    pub fn is_of(&self, app: AppAddress, own: u32) -> bool {
        lock(&self.holders).iter().any(|holder| holder.app == app && [own, 0].contains(&holder.uid))
    }

    /// Returns whether a rule restricts processes of the user `own` in its group. Most of these processes are meant to
    /// be unrestricted.
    pub fn narrows(&self, own: Applicant) -> bool {
        self.index.load().list.is_about(own)
    }

    /// Returns the lines of the rules that admit users other than `own` and root and name no groups, if there are any.
    pub fn without_groups(&self, own: u32) -> Option<Lines> {
        self.index.load().list.without_groups(own)
    }

    /// Returns the groups that rules name. A message to any other group is judged as one to its members alone.
    pub fn groups_in_rules(&self) -> BTreeSet<AppAddress> {
        self.index.load().list.rules.iter().flat_map(|rule| rule.groups.iter().copied()).collect()
    }

    /// Explains the decision for such a message.
    pub fn explain(&self, asked: Question) -> Explanation {
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
    let rule = index.list.describe(rule);
    Explanation { is_allowed, why: format!("{rule}, for {source} to {target}") }
}

fn judge(index: &Index, refusals: &Refusals, asked: Question, is_for_one: bool) -> bool {
    let Verdict::Refused(rule) = index.decide(asked) else { return true };
    // A group message that no rule covers for one of many members is normal for a list, so it is not logged.
    if (is_for_one || rule.is_some()) && refusals.logs_by_list(Time::now()) {
        refusals.count(Time::now(), BY_LIST, &Refused(index, asked));
    } else {
        refusals.count_by_list();
    }
    false
}

/// Builds the question to the list for a message to the application of the node at `here`.
fn question(here: NodeAddress, header: &Header, app: AppAddress) -> Question {
    let destination = header.destination.app;
    Question {
        source: header.source,
        target: Tid::new(here, app),
        group: destination.is_group().then_some(destination),
        class: header.class,
    }
}

/// The list with the names of another incarnation of a node.
struct IncarnationGuard {
    here: NodeAddress,
    index: Index,
    refusals: Arc<Refusals>,
}

impl Guard for IncarnationGuard {
    fn allows(&self, header: &Header, app: AppAddress) -> bool {
        // The sender of a last will has ended, and nothing is tuned then.
        if [SetParameters::KIND, ParameterVote::KIND].contains(&header.kind) {
            return false;
        }
        judge(&self.index, &self.refusals, question(self.here, header, app), header.destination.is_single())
    }

    /// Does nothing: the judged messages were sent by another node.
    fn asks(&self, _: &Header) {}
}

impl Guard for Access {
    fn allows(&self, header: &Header, app: AppAddress) -> bool {
        // Messages of this node's layers to its applications are allowed. No other sender can have such a source here.
        if header.source.node == self.here && header.source.app.is_layer() {
            return true;
        }
        // Before replies: an application that was asked may set no parameters by its reply.
        if let Some(is_allowed) = self.decide_by_role(header, app) {
            return is_allowed;
        }
        if header.flags.has(Flags::REPLY)
            && header.destination.is_single()
            && self.pending.take(Time::now(), header, app)
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
        // Replies of the node's own layers need no permission.
        if header.destination.node != self.here || !header.destination.app.is_layer() {
            self.pending.note(Time::now(), header);
        }
    }

    fn sets(&self, set: &Message) {
        self.participants.note(Time::now(), set);
    }
}

/// A refusal that is formatted only when it is logged.
struct Refused<'a>(&'a Index, Question);

impl fmt::Display for Refused<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self(index, asked) = self;
        write!(f, "{} in class {:?}", explained(index, *asked).why, asked.class)
    }
}

/// The display name of an application.
struct Label(Tid, Option<String>);

impl fmt::Display for Label {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self(tid, Some(name)) => write!(f, "'{name}' at {tid}"),
            Self(tid, None) => write!(f, "{tid}, which has no name in this node's directory"),
        }
    }
}

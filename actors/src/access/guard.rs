//! The list in force, as every sender reads it; read again on request, and told who has which name.

use std::{
    collections::BTreeMap,
    fmt,
    path::PathBuf,
    sync::{Arc, Mutex},
};

use arc_swap::ArcSwap;
use sinew_runtime::{
    router::guard::Guard,
    tid::{AppAddress, NodeAddress, Tid},
    time::Time,
    wire::{Flags, Header},
};

use super::{
    asked::Asked,
    client::{Applicant, ClientRefusal},
    file,
    index::Index,
    rule::{List, Question, Verdict},
};
use crate::{config::ConfigFaults, refusals::Refusals, stores::lock};

/// The cause under which refused messages are counted.
pub(super) const CAUSE: &str = "access list";

/// The access list of one node. It outlives the layers.
pub(crate) struct Access {
    here: NodeAddress,
    /// Where it is read from.
    path: PathBuf,
    refusals: Arc<Refusals>,
    /// SYNC: senders load it without a lock; whoever replaces it holds `names`.
    index: ArcSwap<Index>,
    /// Of two who have the file read again, the later one reads later.
    reloading: Mutex<()>,
    /// Who has which name, here and elsewhere. Writers take turns at it.
    names: Mutex<BTreeMap<Tid, Arc<str>>>,
    /// What the applications of this node may be told in reply.
    asked: Asked,
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
        let names = BTreeMap::new();
        let index = ArcSwap::from_pointee(Index::new(Arc::new(list), here, &names));
        let (reloading, names) = (Mutex::default(), Mutex::new(names));
        Self { here, path, refusals, index, reloading, names, asked: Asked::default() }
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
        let names = lock(&self.names);
        self.index.store(Arc::new(Index::new(Arc::new(list), self.here, &names)));
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
        let mut names = lock(&self.names);
        names.insert(Tid::new(self.here, app), name.into());
        self.index.store(Arc::new(self.index.load().with_names(&names)));
    }

    /// An application of this node has gone for good.
    pub(crate) fn gone(&self, app: AppAddress) {
        self.asked.forget(app);
        let mut names = lock(&self.names);
        if names.remove(&Tid::new(self.here, app)).is_some() {
            self.index.store(Arc::new(self.index.load().with_names(&names)));
        }
    }

    /// These have names on other nodes, or on the one that is given, as those have said; nobody else there has one.
    pub(crate) fn named_elsewhere<'a>(
        &self,
        node: Option<NodeAddress>,
        told: impl Iterator<Item = (Tid, &'a str)>,
    ) {
        let is_meant = |tid: &Tid| tid.node != self.here && node.is_none_or(|node| tid.node == node);
        let told: BTreeMap<_, _> = told.filter(|(tid, _)| is_meant(tid)).collect();
        let mut names = lock(&self.names);
        let known = names.iter().filter(|(tid, _)| is_meant(tid)).map(|(tid, name)| (*tid, &**name));
        if known.eq(told.iter().map(|(tid, name)| (*tid, *name))) {
            return;
        }
        names.retain(|tid, _| !is_meant(tid));
        names.extend(told.into_iter().map(|(tid, name)| (tid, name.into())));
        self.index.store(Arc::new(self.index.load().with_names(&names)));
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

    /// What becomes of such a message, and why.
    pub(crate) fn explain(&self, asked: Question) -> Explanation {
        let index = self.index.load();
        let (is_allowed, rule) = match index.decide(asked) {
            Verdict::Allowed(rule) => (true, Some(rule)),
            Verdict::Refused(rule) => (false, rule),
        };
        let label = |tid: Tid| Label(tid, index.name_of(tid).map(str::to_owned));
        let (source, target) = (label(asked.source), label(asked.target));
        let rule = index.list.in_words(rule);
        Explanation { is_allowed, why: format!("{rule}, for {source} to {target}") }
    }
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
        let destination = header.destination.app;
        let asked = Question {
            source: header.source,
            target: Tid::new(self.here, app),
            group: destination.is_group().then_some(destination),
            class: header.class,
        };
        let is_allowed = matches!(self.index.load().decide(asked), Verdict::Allowed(_));
        if !is_allowed {
            self.refuse(asked);
        }
        is_allowed
    }

    fn asks(&self, header: &Header) {
        // What the node's own layers reply needs no leave.
        if header.destination.node != self.here || !header.destination.app.is_layer() {
            self.asked.note(Time::now(), header);
        }
    }
}

impl Access {
    #[cold]
    fn refuse(&self, asked: Question) {
        self.refusals.count(Time::now(), CAUSE, &Refused(self, asked));
    }
}

/// Put into words only where it is logged.
struct Refused<'a>(&'a Access, Question);

impl fmt::Display for Refused<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self(access, asked) = self;
        write!(f, "{} in class {:?}", access.explain(*asked).why, asked.class)
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

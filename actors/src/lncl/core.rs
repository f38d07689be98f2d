//! Who is registered on this node. Pure: no socket, no clock.

mod kinds;
#[cfg(test)]
mod tests;

use std::{collections::BTreeMap, fmt};

use sinew_runtime::{
    app::{Requirement, RequirementError},
    tid::AppAddress,
    wire::Kind,
};

use self::kinds::Kinds;

/// Longest name in bytes.
pub(crate) const NAME_MAX: usize = 63;
/// Requirements of one application, and payload types that it may name, at most.
pub(crate) const NAMES_MAX: usize = 64;

/// How many there may be.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Limits {
    /// Applications of the node, in all its processes.
    pub(crate) apps: usize,
    /// Those of them in processes that come in through the door.
    pub(crate) clients: usize,
    /// Those of one such process.
    pub(crate) per_process: usize,
}

impl Limits {
    /// Those of all guests, of whom there may be any number: half of the places are the robot's own whatever they do, where there are two or more.
    fn guests(self) -> usize {
        (self.clients / 2).max(1)
    }

    /// Those of one guest user: half of what guests have, so that it keeps no other one out by itself.
    fn per_guest(self) -> usize {
        (self.clients / 4).max(1)
    }
}

/// One connection of another process; never used again in a node's life.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct ClientId(pub(crate) u64);

/// Whom a registration belongs to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Owner {
    /// The node's own process.
    Node,
    /// A connection of the process `pid`.
    Client { id: ClientId, pid: i32 },
}

impl fmt::Display for Owner {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Node => f.write_str("the node's own process"),
            Self::Client { pid, .. } => write!(f, "process {pid}"),
        }
    }
}

/// Which user an application runs as.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum User {
    /// The node's own, or root: the application is one of the robot's own.
    Own,
    /// This one, whom the access list lets in.
    Guest(u32),
}

impl User {
    /// That of a process of `uid`, at a node that runs as `own`.
    pub(crate) const fn of(uid: u32, own: u32) -> Self {
        if uid == own || uid == 0 { Self::Own } else { Self::Guest(uid) }
    }
}

/// Which address is asked for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Address {
    /// This one, out of the fixed range.
    Fixed(AppAddress),
    /// Any free one of the dynamic range.
    Dynamic,
    /// This one of the dynamic range, which it had before; any free one if somebody else has it.
    Former(AppAddress),
}

/// What an application asks for when it registers.
#[derive(Clone, Debug)]
pub(crate) struct Request {
    /// The address that it wants.
    pub(crate) address: Address,
    /// Its name, unique on the node.
    pub(crate) name: Option<String>,
    /// What it requires.
    pub(crate) requires: Vec<String>,
    /// Names of the payload types that it sends or handles, as far as it tells.
    pub(crate) kinds: Vec<String>,
    /// Whom it belongs to.
    pub(crate) owner: Owner,
    /// Which user it runs as.
    pub(crate) user: User,
}

/// Why an application was not registered. Nothing changed.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum RegisterError {
    /// The caller's name is empty, too long or has control characters in it.
    #[error("the name {0:?} cannot be used: 1 to 63 bytes without control characters are allowed")]
    BadName(String),
    /// Another application of the node has this name.
    #[error(
        "the name '{name}' is taken by application {holder} of {owner}; choose another name or end that one first"
    )]
    NameTaken {
        /// The name.
        name: String,
        /// Who has it.
        holder: AppAddress,
        /// The process that it is in, in words.
        owner: String,
    },
    /// The address is not one that users may choose.
    #[error("address {0} is not one to choose: fixed addresses are 1000 to 7fffffff, hexadecimal")]
    NotFixed(AppAddress),
    /// The node's access list does not let this user register so.
    #[error("{0}")]
    NotAllowed(String),
    /// Another application of the node has this address.
    #[error(
        "address {address} is taken by {holder} of {owner}; choose another address or end that one first"
    )]
    AddressTaken {
        /// The address.
        address: AppAddress,
        /// The name of its holder, in words.
        holder: String,
        /// The process that it is in, in words.
        owner: String,
    },
    /// The node has as many applications as its configuration allows.
    #[error("the node has {limit} applications, which is its limit; raise `lncl.apps_max`")]
    NodeFull {
        /// The limit in force.
        limit: usize,
    },
    /// As many applications of other processes are registered as the node's configuration allows.
    #[error(
        "the node serves {limit} connections of other processes, which is its limit; raise `lncl.clients_max`"
    )]
    ClientsFull {
        /// The limit in force.
        limit: usize,
    },
    /// The user, whom the access list lets in, has as many applications as one such user may have.
    #[error(
        "user {uid} has {limit} applications here, a quarter of `lncl.clients_max`, which is the limit for a user whom only the access list \
         lets in; end one, or raise it"
    )]
    GuestFull {
        /// The user.
        uid: u32,
        /// The limit.
        limit: usize,
    },
    /// Users whom the access list lets in have as many applications as all of them may have together.
    #[error(
        "users whom only the access list lets in have {limit} applications here, half of `lncl.clients_max`, which is the limit for all of \
         them together; end one, or raise it"
    )]
    GuestsFull {
        /// The limit.
        limit: usize,
    },
    /// The node has not looked yet at what was registered and given back before.
    #[error(
        "the node has {waiting} changes of applications to look at, and takes no further one before; register again in a moment"
    )]
    Busy {
        /// Changes that wait.
        waiting: usize,
    },
    /// The process has as many addresses as one process may have.
    #[error(
        "process {pid} has {limit} addresses, which is the limit for one process; unregister some, or raise \
         `lncl.clients_per_process_max`"
    )]
    ProcessFull {
        /// The process.
        pid: i32,
        /// The limit.
        limit: usize,
    },
    /// A list in the request is longer than the limit.
    #[error("{found} {what} are more than the {limit} that one application may name")]
    TooMany {
        /// Which list, in words.
        what: &'static str,
        /// Its length.
        found: usize,
        /// The limit.
        limit: usize,
    },
    /// The caller requires something in words that say nothing.
    #[error(transparent)]
    BadRequirement(#[from] RequirementError),
    /// Two names of payload types have the same id on the wire.
    #[error("payload type '{name}' has the same id {kind} as '{other}', already in use; rename one of them")]
    KindCollision {
        /// The newcomer.
        name: String,
        /// Whom it collides with.
        other: String,
        /// The id that they share.
        kind: Kind,
    },
}

#[derive(Debug)]
struct Entry {
    name: Option<String>,
    owner: Owner,
    user: User,
}

/// Who is registered on this node. It outlives LNCL's actor.
#[derive(Debug, Default)]
pub(crate) struct Registry {
    apps: BTreeMap<AppAddress, Entry>,
    names: BTreeMap<String, AppAddress>,
    kinds: Kinds,
    next_dynamic: u32,
    next_client: u64,
    next_link: u64,
}

impl Registry {
    /// Registers an application on a node that takes at most so many.
    ///
    /// # Errors
    /// Why not; nothing changed.
    pub(crate) fn register(&mut self, request: Request, limits: Limits) -> Result<AppAddress, RegisterError> {
        check_lists(&request)?;
        self.check_room(request.owner, limits)?;
        self.check_share(request.user, limits)?;
        self.check_name(request.name.as_deref())?;
        let kinds = self.kinds.check(request.user, &request.kinds)?;
        let app = match request.address {
            Address::Fixed(app) => self.free_fixed(app)?,
            Address::Former(app) if app.is_dynamic() && !self.apps.contains_key(&app) => app,
            Address::Dynamic | Address::Former(_) => self.free_dynamic(),
        };
        self.kinds.claim(request.user, app, kinds, limits.apps);
        if let Some(name) = &request.name {
            self.names.insert(name.clone(), app);
        }
        self.apps.insert(app, Entry { name: request.name, owner: request.owner, user: request.user });
        Ok(app)
    }

    /// Removes an application. Returns whether it was there.
    pub(crate) fn unregister(&mut self, app: AppAddress) -> bool {
        let Some(entry) = self.apps.remove(&app) else { return false };
        if let Some(name) = entry.name {
            self.names.remove(&name);
        }
        self.kinds.forget(app);
        true
    }

    /// Removes all that belongs to `owner`, and says what that was.
    pub(crate) fn remove_owner(&mut self, owner: Owner) -> Vec<AppAddress> {
        let owned = self.owned_by(|other| other == owner);
        for app in &owned {
            self.unregister(*app);
        }
        owned
    }

    /// The applications in other processes.
    pub(crate) fn in_other_processes(&self) -> Vec<AppAddress> {
        self.owned_by(|owner| owner != Owner::Node)
    }

    /// An identity for a new connection.
    pub(crate) fn new_client(&mut self) -> ClientId {
        self.next_client += 1;
        ClientId(self.next_client)
    }

    /// One that counts links from `number` on. Links outlive their node, so each of its lives begins elsewhere.
    pub(crate) fn counting_links_from(number: u64) -> Self {
        Self { next_link: number, ..Self::default() }
    }

    /// A number for a new link between two applications; never used again, in other lives of the node neither.
    pub(crate) fn new_link(&mut self) -> u64 {
        self.next_link = self.next_link.wrapping_add(1);
        self.next_link
    }

    /// The application called `name`.
    pub(crate) fn resolve(&self, name: &str) -> Option<AppAddress> {
        self.names.get(name).copied()
    }

    /// Every name that is taken on this node.
    pub(crate) fn names(&self) -> impl Iterator<Item = String> + '_ {
        self.names.keys().cloned()
    }

    /// Whom the registration of `app` belongs to, if it has one.
    pub(crate) fn owner_of(&self, app: AppAddress) -> Option<Owner> {
        self.apps.get(&app).map(|entry| entry.owner)
    }

    /// The name of `app`, or its address where it has none.
    pub(crate) fn name_of(&self, app: AppAddress) -> String {
        let name = self.apps.get(&app).and_then(|entry| entry.name.clone());
        name.unwrap_or_else(|| app.to_string())
    }

    /// The name of `app`, if it has one.
    pub(crate) fn own_name_of(&self, app: AppAddress) -> Option<String> {
        self.apps.get(&app).and_then(|entry| entry.name.clone())
    }

    /// How many applications there are.
    #[cfg(test)]
    pub(crate) fn len(&self) -> usize {
        self.apps.len()
    }

    fn owned_by(&self, is_owner: impl Fn(Owner) -> bool) -> Vec<AppAddress> {
        self.apps.iter().filter(|(_, entry)| is_owner(entry.owner)).map(|(app, _)| *app).collect()
    }

    fn check_room(&self, owner: Owner, limits: Limits) -> Result<(), RegisterError> {
        if self.apps.len() >= limits.apps {
            return Err(RegisterError::NodeFull { limit: limits.apps });
        }
        let Owner::Client { pid, .. } = owner else { return Ok(()) };
        let (mut all, mut own) = (0, 0);
        for entry in self.apps.values() {
            if let Owner::Client { pid: theirs, .. } = entry.owner {
                all += 1;
                own += usize::from(theirs == pid);
            }
        }
        if own >= limits.per_process {
            return Err(RegisterError::ProcessFull { pid, limit: limits.per_process });
        }
        if all >= limits.clients {
            return Err(RegisterError::ClientsFull { limit: limits.clients });
        }
        Ok(())
    }

    /// Guests leave room for the robot's own, and one user of theirs for others. spec: LNCL-13
    fn check_share(&self, user: User, limits: Limits) -> Result<(), RegisterError> {
        let User::Guest(uid) = user else { return Ok(()) };
        let (mut all, mut own) = (0, 0);
        for entry in self.apps.values() {
            if let User::Guest(theirs) = entry.user {
                all += 1;
                own += usize::from(theirs == uid);
            }
        }
        if own >= limits.per_guest() {
            return Err(RegisterError::GuestFull { uid, limit: limits.per_guest() });
        }
        if all >= limits.guests() {
            return Err(RegisterError::GuestsFull { limit: limits.guests() });
        }
        Ok(())
    }

    fn check_name(&self, name: Option<&str>) -> Result<(), RegisterError> {
        // spec: LNCL-5
        let Some(name) = name else { return Ok(()) };
        check_spelling(name)?;
        let Some(holder) = self.names.get(name) else { return Ok(()) };
        let owner = self.owner_in_words(*holder);
        Err(RegisterError::NameTaken { name: name.to_owned(), holder: *holder, owner })
    }

    /// What the type of this id is called, if an application has said so.
    pub(crate) fn kind_name(&self, kind: Kind) -> Option<&str> {
        self.kinds.name(kind)
    }

    fn free_fixed(&self, app: AppAddress) -> Result<AppAddress, RegisterError> {
        if !app.is_fixed() {
            return Err(RegisterError::NotFixed(app));
        }
        let Some(entry) = self.apps.get(&app) else { return Ok(app) };
        let holder = entry
            .name
            .as_ref()
            .map_or_else(|| "an application without a name".to_owned(), |n| format!("'{n}'"));
        Err(RegisterError::AddressTaken { address: app, holder, owner: entry.owner.to_string() })
    }

    /// The next free address, round the whole range: one that was given back is not given out again soon, so that a
    /// late message for its former holder finds nobody and not somebody else. spec: LNCL-5
    fn free_dynamic(&mut self) -> AppAddress {
        loop {
            let index = self.next_dynamic;
            let Some(app) = AppAddress::dynamic(index) else {
                self.next_dynamic = 0;
                continue;
            };
            self.next_dynamic += 1;
            if !self.apps.contains_key(&app) {
                return app;
            }
            // Ends: there are 1.8 billion dynamic addresses, and `apps_max` is far below.
        }
    }

    fn owner_in_words(&self, app: AppAddress) -> String {
        self.apps.get(&app).map_or_else(String::new, |entry| entry.owner.to_string())
    }
}

fn check_spelling(name: &str) -> Result<(), RegisterError> {
    if name.is_empty() || name.len() > NAME_MAX || name.chars().any(char::is_control) {
        // The name itself may be long; what is told of it is not.
        return Err(RegisterError::BadName(name.chars().take(NAME_MAX).collect()));
    }
    Ok(())
}

fn check_lists(request: &Request) -> Result<(), RegisterError> {
    for (what, list) in [("requirements", &request.requires), ("payload types", &request.kinds)] {
        if list.len() > NAMES_MAX {
            return Err(RegisterError::TooMany { what, found: list.len(), limit: NAMES_MAX });
        }
    }
    request.kinds.iter().try_for_each(|name| check_spelling(name))?;
    request.requires.iter().try_for_each(|text| text.parse::<Requirement>().map(drop))?;
    Ok(())
}

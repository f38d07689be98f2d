//! The registry of this node's applications. Pure: no socket, no clock.

mod kinds;
#[cfg(test)]
mod tests;

use std::{collections::BTreeMap, fmt};

use sinew_model::facts::User;
use sinew_runtime::{
    app::{Requirement, RequirementError},
    name::{NAME_BYTES_MAX, NameError, check_name},
    tid::AppAddress,
    wire::Kind,
};
use sinew_session::book::ClientId;

use self::kinds::Kinds;
use crate::command::ClaimError;

/// Maximum number of requirements of one application, and of the payload types that it names.
pub(crate) const NAMES_MAX: usize = 64;

/// Limits on the number of applications.
#[derive(Clone, Copy, Debug)]
pub struct Limits {
    /// Applications of the node, in all its processes.
    pub apps: usize,
    /// Applications in other processes, which connect through the client socket.
    pub clients: usize,
    /// Applications of one such process.
    pub per_process: usize,
}

impl Limits {
    /// Returns the limit on all guests. Half of the slots are reserved for the node's own applications, if there are
    /// two or more.
    fn guests(self) -> usize {
        (self.clients / 2).max(1)
    }

    /// Returns the limit on one guest user: half of the guests' slots, so that it cannot lock out all other guests.
    fn per_guest(self) -> usize {
        (self.clients / 4).max(1)
    }
}

/// The owner of a registration.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Owner {
    /// The node's own process.
    Node,
    /// A command of the node: the processes that it starts for it register its name.
    Command,
    /// A connection of the process `pid`; 0 if the kernel does not report it, as for a process of another PID
    /// namespace.
    Client { id: ClientId, pid: i32 },
}

impl fmt::Display for Owner {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Node => f.write_str("the node's own process"),
            Self::Command => f.write_str("a command of the node"),
            Self::Client { pid: 0, .. } => f.write_str("a process of another PID namespace"),
            Self::Client { pid, .. } => write!(f, "process {pid}"),
        }
    }
}

/// The requested address.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Address {
    /// This address of the fixed range.
    Fixed(AppAddress),
    /// Any free address of the dynamic range.
    Dynamic,
    /// This address of the dynamic range, which the application had before; any free one if it is taken.
    Former(AppAddress),
}

/// A request for registration.
#[derive(Clone, Debug)]
pub struct Request {
    /// The requested address.
    pub address: Address,
    /// Its name, unique on the node.
    pub name: Option<String>,
    /// The applications that it requires.
    pub requires: Vec<String>,
    /// Names of the payload types that it sends or handles, if it reports them.
    pub kinds: Vec<String>,
    /// The owner of the registration.
    pub owner: Owner,
    /// The user that it runs as.
    pub user: User,
}

/// Reason for a failed registration. Nothing changed.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum RegisterError {
    /// The caller's name, or that of a payload type, breaks the grammar of [names](sinew_runtime::name).
    #[error("the name {name:?} cannot be used: {why}")]
    BadName {
        /// The name, or its beginning.
        name: String,
        /// Which rule it breaks.
        why: NameError,
    },
    /// Another application of the node has this name.
    #[error(
        "the name '{name}' is taken by application {holder} of {owner}; choose another name or end that one first"
    )]
    NameTaken {
        /// The name.
        name: String,
        /// The application that has it.
        holder: AppAddress,
        /// Its process, in words.
        owner: String,
    },
    /// The address is not one that users may choose.
    #[error("address {0} is not one to choose: fixed addresses are 1000 to 7fffffff, hexadecimal")]
    NotFixed(AppAddress),
    /// The node's access list does not let this user register so.
    #[error("{0}")]
    NotAllowed(String),
    /// The name is that of a command of the node.
    #[error("the name '{name}' belongs to a command of this node: {why}")]
    Command {
        /// The name.
        name: String,
        /// Why this process does not get it.
        why: ClaimError,
    },
    /// Another application of the node has this address.
    #[error(
        "address {address} is taken by {holder} of {owner}; choose another address or end that one first"
    )]
    AddressTaken {
        /// The address.
        address: AppAddress,
        /// The name of its holder, in words.
        holder: String,
        /// Its process, in words.
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
    /// The guest user has as many applications as one guest may have.
    #[error(
        "user {uid} has {limit} applications here, a quarter of `lncl.clients_max`, which is the limit for a user that only the access list \
         admits; end one, or raise it"
    )]
    GuestFull {
        /// The user.
        uid: u32,
        /// The limit.
        limit: usize,
    },
    /// The guests have as many applications as all of them may have together.
    #[error(
        "users that only the access list admits have {limit} applications here, half of `lncl.clients_max`, which is the limit for all of \
         them together; end one, or raise it"
    )]
    GuestsFull {
        /// The limit.
        limit: usize,
    },
    /// The node has not yet processed earlier registrations and removals.
    #[error(
        "the node has {waiting} pending changes of applications, and accepts no further one before; register again in a moment"
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
    /// The text of a requirement cannot be parsed.
    #[error(transparent)]
    BadRequirement(#[from] RequirementError),
    /// Two names of payload types have the same id on the wire.
    #[error("payload type '{name}' has the same id {kind} as '{other}', already in use; rename one of them")]
    KindCollision {
        /// The new name.
        name: String,
        /// The name that it collides with.
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

/// The applications registered on this node. The registry outlives LNCL's actor.
#[derive(Debug, Default)]
pub struct Registry {
    apps: BTreeMap<AppAddress, Entry>,
    names: BTreeMap<String, AppAddress>,
    kinds: Kinds,
    next_dynamic: u32,
    next_client: u64,
    next_link: u64,
}

impl Registry {
    /// Registers an application, within `limits`.
    ///
    /// # Errors
    /// The reason; nothing changed.
    pub fn register(&mut self, request: Request, limits: Limits) -> Result<AppAddress, RegisterError> {
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

    /// Adds the names of payload types that the process of a command uses.
    ///
    /// # Errors
    /// The reason; nothing changed.
    pub fn declare_kinds(
        &mut self,
        app: AppAddress,
        names: &[String],
        limits: Limits,
    ) -> Result<(), RegisterError> {
        check_length("payload types", names)?;
        names.iter().try_for_each(|name| check_spelling(name))?;
        let kinds = self.kinds.check(User::Own, names)?;
        self.kinds.claim(User::Own, app, kinds, limits.apps);
        Ok(())
    }

    /// Removes an application. Returns whether it was registered.
    pub fn unregister(&mut self, app: AppAddress) -> bool {
        let Some(entry) = self.apps.remove(&app) else { return false };
        if let Some(name) = entry.name {
            self.names.remove(&name);
        }
        self.kinds.forget(app);
        true
    }

    /// Removes all applications of `owner`, and returns them.
    pub fn remove_owner(&mut self, owner: Owner) -> Vec<AppAddress> {
        let owned = self.owned_by(|other| other == owner);
        for app in &owned {
            self.unregister(*app);
        }
        owned
    }

    /// Returns the applications in other processes.
    pub fn in_other_processes(&self) -> Vec<AppAddress> {
        self.owned_by(|owner| matches!(owner, Owner::Client { .. }))
    }

    /// Returns the id of a new connection.
    pub fn new_client(&mut self) -> ClientId {
        self.next_client += 1;
        ClientId(self.next_client)
    }

    /// Creates a registry that numbers links from `number` on. Links outlive their node, so each incarnation starts at
    /// another number.
    pub fn counting_links_from(number: u64) -> Self {
        Self { next_link: number, ..Self::default() }
    }

    /// Returns the number of a new link between two applications. It is never used again, not even by later
    /// incarnations of the node.
    pub fn new_link(&mut self) -> u64 {
        self.next_link = self.next_link.wrapping_add(1);
        self.next_link
    }

    /// Returns the application with this name.
    pub fn resolve(&self, name: &str) -> Option<AppAddress> {
        self.names.get(name).copied()
    }

    /// Returns all names in use on this node.
    pub fn names(&self) -> impl Iterator<Item = String> + '_ {
        self.names.keys().cloned()
    }

    /// Returns the applications of this node that have a name.
    pub fn named(&self) -> impl Iterator<Item = (&str, AppAddress)> {
        self.names.iter().map(|(name, app)| (&**name, *app))
    }

    /// Returns the owner of `app`, if it is registered.
    pub fn owner_of(&self, app: AppAddress) -> Option<Owner> {
        self.apps.get(&app).map(|entry| entry.owner)
    }

    /// Returns the name of `app`, or its address if it has none.
    pub fn name_of(&self, app: AppAddress) -> String {
        let name = self.apps.get(&app).and_then(|entry| entry.name.clone());
        name.unwrap_or_else(|| app.to_string())
    }

    /// Returns the name of `app`, if it has one.
    pub fn own_name_of(&self, app: AppAddress) -> Option<String> {
        self.apps.get(&app).and_then(|entry| entry.name.clone())
    }

    /// Returns the number of applications.
    #[cfg(any(test, feature = "testing"))]
    #[allow(clippy::len_without_is_empty, reason = "tests count")]
    pub fn len(&self) -> usize {
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
                // A pid of 0 is any process of another PID namespace.
                own += usize::from(theirs == pid && pid != 0);
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

    /// Checks the quotas of guests: they leave room for the node's own applications, and one user leaves room for
    /// others. spec: LNCL-13
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
        let owner = self.describe_owner(*holder);
        Err(RegisterError::NameTaken { name: name.to_owned(), holder: *holder, owner })
    }

    /// Returns the name of this type, if an application registered it.
    pub fn kind_name(&self, kind: Kind) -> Option<&str> {
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

    /// Returns the next free address, round the whole range. A released address is not used again soon, so a late
    /// message for its former owner reaches no other application. spec: LNCL-5
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
            // The loop ends: there are 1.8 billion dynamic addresses, and `apps_max` is far below.
        }
    }

    fn describe_owner(&self, app: AppAddress) -> String {
        self.apps.get(&app).map_or_else(String::new, |entry| entry.owner.to_string())
    }
}

fn check_spelling(name: &str) -> Result<(), RegisterError> {
    // The name itself may be long; the error is bounded.
    let beginning = || name.chars().take(NAME_BYTES_MAX).collect();
    check_name(name).map_err(|why| RegisterError::BadName { name: beginning(), why })
}

fn check_length(what: &'static str, list: &[String]) -> Result<(), RegisterError> {
    let found = list.len();
    if found > NAMES_MAX { Err(RegisterError::TooMany { what, found, limit: NAMES_MAX }) } else { Ok(()) }
}

fn check_lists(request: &Request) -> Result<(), RegisterError> {
    check_length("requirements", &request.requires)?;
    check_length("payload types", &request.kinds)?;
    request.kinds.iter().try_for_each(|name| check_spelling(name))?;
    request.requires.iter().try_for_each(|text| text.parse::<Requirement>().map(drop))?;
    Ok(())
}

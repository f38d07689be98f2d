//! Names of payload types by their ids, as applications of this node register them. Pure.
//!
//! An id is 31 bits of a hash of the type's name. Names that collide with types of the robot can be found
//! within moments. So a name that a guest registers binds only guests of the same user, and only while that guest is
//! registered.

use std::collections::BTreeMap;

use sinew_model::facts::User;
use sinew_runtime::{tid::AppAddress, wire::Kind};

use super::RegisterError;

/// Names kept for the node's lifetime, for each application that the node may have.
const KEPT_PER_APP: usize = 16;

/// Names of types by id. No two names share an id.
pub(super) type Named = BTreeMap<Kind, String>;

/// The names of all payload types. They decide registrations and displayed names; no message is checked or parsed by
/// them.
#[derive(Debug, Default)]
pub(super) struct Kinds {
    /// Names that the node's own applications registered. They outlive the application: an id must not change its
    /// meaning during the node's lifetime. [`Kinds::keep`] states the bound.
    own: Named,
    /// Names of the registered guests. One application may register a limited number of names.
    guests: BTreeMap<(Kind, AppAddress), GuestName>,
    /// The ids that each guest registered.
    registered: BTreeMap<AppAddress, Vec<Kind>>,
}

/// The name that a guest gives a type.
#[derive(Debug)]
struct GuestName {
    uid: u32,
    name: String,
}

impl Kinds {
    /// Returns the ids of `names`, after checking that none means another type to an application of `user`.
    /// spec: LNCL-8
    ///
    /// # Errors
    /// An id has another meaning already; nothing changed.
    pub(super) fn check(&self, user: User, names: &[String]) -> Result<Named, RegisterError> {
        let mut claimed = Named::new();
        for name in names {
            let kind = Kind::named(name);
            let other = self.meaning(kind, user).or_else(|| claimed.get(&kind).map(String::as_str));
            if let Some(other) = other.filter(|other| *other != name.as_str()) {
                return Err(RegisterError::KindCollision {
                    name: name.clone(),
                    other: other.to_owned(),
                    kind,
                });
            }
            claimed.insert(kind, name.clone());
        }
        Ok(claimed)
    }

    /// Records the names of the application at `app`; [`Kinds::check`] has returned them.
    pub(super) fn claim(&mut self, user: User, app: AppAddress, named: Named, apps_max: usize) {
        match user {
            User::Own => self.keep(named, apps_max),
            User::Guest(uid) => self.note(uid, app, named),
        }
    }

    /// Removes the application. The names of a guest are removed with it.
    pub(super) fn forget(&mut self, app: AppAddress) {
        for kind in self.registered.remove(&app).unwrap_or_default() {
            self.guests.remove(&(kind, app));
        }
    }

    /// Returns the name of a type, for display. A name of the node's own applications has priority over that of a
    /// guest.
    pub(super) fn name(&self, kind: Kind) -> Option<&str> {
        let own = self.own.get(&kind).map(String::as_str);
        own.or_else(|| self.of_guests(kind).next().map(|guest| guest.name.as_str()))
    }

    /// Returns the meaning of the id to an application of `user`. The node's own applications consider only each other.
    fn meaning(&self, kind: Kind, user: User) -> Option<&str> {
        let own = self.own.get(&kind).map(String::as_str);
        match user {
            User::Own => own,
            User::Guest(uid) => own.or_else(|| {
                let of_the_same = |guest: &&GuestName| guest.uid == uid;
                self.of_guests(kind).find(of_the_same).map(|guest| guest.name.as_str())
            }),
        }
    }

    fn of_guests(&self, kind: Kind) -> impl Iterator<Item = &GuestName> {
        self.guests.range((kind, AppAddress::NONE)..=(kind, AppAddress::ALL)).map(|(_, name)| name)
    }

    /// Keeps up to 16 names for each application that the node may have. Further names are neither checked
    /// for collisions nor displayed.
    fn keep(&mut self, named: Named, apps_max: usize) {
        let bound = apps_max.saturating_mul(KEPT_PER_APP);
        for (kind, name) in named {
            if self.own.len() < bound {
                self.own.insert(kind, name);
            }
        }
    }

    /// The number of names is bounded by `lncl.clients_max`, with 64 names for each client.
    fn note(&mut self, uid: u32, app: AppAddress, named: Named) {
        self.registered.insert(app, named.keys().copied().collect());
        for (kind, name) in named {
            self.guests.insert((kind, app), GuestName { uid, name });
        }
    }

    /// Returns the number of names of the node's own applications, and of guests.
    #[cfg(test)]
    pub(super) fn counts(&self) -> (usize, usize) {
        (self.own.len(), self.guests.len())
    }
}

//! What the ids of payload types mean on this node, as far as applications have said. Pure.
//!
//! An id is 31 bits of a hash of its type's name, so that anybody finds names in a moment that share the ids of the robot's own types. So
//! what a guest names binds nobody but guests of the same user, and these only while it is registered.

use std::collections::BTreeMap;

use sinew_runtime::{tid::AppAddress, wire::Kind};

use super::{RegisterError, User};

/// Names that are kept for the node's life, for each application that it may have.
const KEPT_PER_APP: usize = 16;

/// Names of types by their ids, none of which is another one's.
pub(super) type Named = BTreeMap<Kind, String>;

/// Who calls which id what. It decides who is registered, and what people are told; no message is judged or read by it.
#[derive(Debug, Default)]
pub(super) struct Kinds {
    /// What the robot's own have said. Kept when an application goes: an id must not change its meaning in a node's life. See
    /// [`Kinds::keep`] for the bound.
    own: Named,
    /// What guests have said that are registered: as many names of each as one application may tell.
    guests: BTreeMap<(Kind, AppAddress), GuestsName>,
    /// The ids of each of them.
    told: BTreeMap<AppAddress, Vec<Kind>>,
}

/// What a guest calls a type.
#[derive(Debug)]
struct GuestsName {
    uid: u32,
    name: String,
}

impl Kinds {
    /// The ids of `names`, none of which means anything else to an application of `user`. spec: LNCL-8
    ///
    /// # Errors
    /// One does; nothing changed.
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

    /// Remembers what the application at `app` calls these ids, which were checked.
    pub(super) fn claim(&mut self, user: User, app: AppAddress, named: Named, apps_max: usize) {
        match user {
            User::Own => self.keep(named, apps_max),
            User::Guest(uid) => self.note(uid, app, named),
        }
    }

    /// The application has gone. What a guest has said goes with it.
    pub(super) fn forget(&mut self, app: AppAddress) {
        for kind in self.told.remove(&app).unwrap_or_default() {
            self.guests.remove(&(kind, app));
        }
    }

    /// What the type of this id is called, for people: by the robot's own, else by a guest.
    pub(super) fn name(&self, kind: Kind) -> Option<&str> {
        let own = self.own.get(&kind).map(String::as_str);
        own.or_else(|| self.of_guests(kind).next().map(|told| told.name.as_str()))
    }

    /// What the id means to an application of `user`: the robot's own heed each other alone.
    fn meaning(&self, kind: Kind, user: User) -> Option<&str> {
        let own = self.own.get(&kind).map(String::as_str);
        match user {
            User::Own => own,
            User::Guest(uid) => own.or_else(|| {
                let of_the_same = |told: &&GuestsName| told.uid == uid;
                self.of_guests(kind).find(of_the_same).map(|told| told.name.as_str())
            }),
        }
    }

    fn of_guests(&self, kind: Kind) -> impl Iterator<Item = &GuestsName> {
        self.guests.range((kind, AppAddress::NONE)..=(kind, AppAddress::ALL)).map(|(_, told)| told)
    }

    /// Up to 16 names for each application that the node may have; those past that bound are not watched for collisions, and not shown.
    fn keep(&mut self, named: Named, apps_max: usize) {
        let bound = apps_max.saturating_mul(KEPT_PER_APP);
        for (kind, name) in named {
            if self.own.len() < bound {
                self.own.insert(kind, name);
            }
        }
    }

    /// Bounded by who may be registered: `lncl.clients_max`, with 64 names each.
    fn note(&mut self, uid: u32, app: AppAddress, named: Named) {
        self.told.insert(app, named.keys().copied().collect());
        for (kind, name) in named {
            self.guests.insert((kind, app), GuestsName { uid, name });
        }
    }

    /// How many names are kept of the robot's own, and of guests.
    #[cfg(test)]
    pub(super) fn counts(&self) -> (usize, usize) {
        (self.own.len(), self.guests.len())
    }
}

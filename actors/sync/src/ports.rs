//! What other layers ask the sync manager.

use std::sync::TryLockError;

use sinew_model::{
    cause::Cause,
    directory::DirectoryEntry,
    facts::User,
    ports::{AppLifecycle, Names, NodeIncarnation},
};
use sinew_runtime::{
    lock,
    tid::{AppAddress, Tid},
};

use super::{State, monitors, wills};

impl Names for State {
    fn called(&self, name: &str) -> Vec<Tid> {
        lock(&self.core).called(name)
    }

    fn all(&self) -> Vec<String> {
        let names = lock(&self.core).names();
        names.iter().map(ToString::to_string).collect()
    }

    fn directory(&self) -> Vec<DirectoryEntry> {
        lock(&self.core).directory()
    }

    fn missing_in_brief(&self, app: AppAddress) -> Option<Vec<(String, &'static str)>> {
        match self.core.try_lock() {
            Ok(core) => Some(core.missing_in_brief(app)),
            Err(TryLockError::Poisoned(core)) => Some(core.into_inner().missing_in_brief(app)),
            Err(TryLockError::WouldBlock) => None,
        }
    }
}

impl AppLifecycle for State {
    fn began(&self, app: AppAddress, user: User) {
        let began = match user {
            User::Own => monitors::Input::Started { app },
            User::Guest(_) => monitors::Input::GuestStarted { app },
        };
        monitors::feed_deferred(self, began);
    }

    fn ended(&self, app: AppAddress, cause: Cause, is_gone: bool) {
        monitors::feed_deferred(self, monitors::Input::Ended { app, cause, is_gone });
    }

    fn revoke(&self, (node, incarnation): NodeIncarnation) {
        wills::revoke(self, node, incarnation);
    }
}

//! The lives of this node's applications: they come, become ready, fail, go.

use sinew_runtime::{app::Requirement, tid::AppAddress, time::Time, wire::Kind};

use super::{
    Core,
    apps::{Newcomer, State, Wait},
};
use crate::{
    lncl::AppFact,
    sync::list::{Ended, KINDS_MAX},
};

impl Core {
    pub(super) fn app_changed(&mut self, now: Time, fact: AppFact) {
        match fact {
            // Told again, as after a restart of LNCL: nothing has changed.
            AppFact::Registered { app, name, requires, user }
                if self.apps.knows(app, name.as_deref(), &requires, user) => {}
            AppFact::Registered { app, name, requires, user } => {
                let wait = Wait::begun(now, self.requirement_deadline);
                let requires = self.read_requirements(app, requires);
                let newcomer = Newcomer { name: name.clone(), user, requires };
                let refused = self.apps.register(app, newcomer, wait);
                if let Some(name) = refused {
                    self.refuse(
                        "name",
                        format!("{app} cannot be called {name:?}: not 1 to 63 bytes, or taken"),
                    );
                }
                self.forget_not_taken(app);
                self.life_ended(now, app);
                self.note_same_name(name.as_deref().unwrap_or_default());
                self.own_list_changed(now);
            }
            AppFact::Handles { app, kinds } => self.app_handles(now, app, kinds),
            AppFact::Ready { app } => self.app_ready(now, app),
            AppFact::Down { app } => self.app_ended(now, app, Ended::Failed),
            AppFact::Stopped { app } => self.app_ended(now, app, Ended::Stopped),
            AppFact::Unregistered { app } => {
                self.apps.remove(app);
                self.forget_not_taken(app);
                self.life_ended(now, app);
                self.own_list_changed(now);
            }
            // The shell looks up which they are and says so by `Input::GroupsChanged`.
            AppFact::GroupsChanged => {}
        }
    }

    /// What its door has checked. A text that is none all the same is a name that nobody has: who asks for it does not start.
    fn read_requirements(&mut self, app: AppAddress, texts: Vec<String>) -> Vec<Requirement> {
        let read = |text: String| {
            text.parse().unwrap_or_else(|fault| {
                self.refuse("requirement", format!("of {app}: {fault}"));
                Requirement::name(text)
            })
        };
        texts.into_iter().map(read).collect()
    }

    fn app_handles(&mut self, now: Time, address: AppAddress, mut kinds: Vec<Kind>) {
        kinds.truncate(KINDS_MAX);
        if let Some(app) = self.apps.get_mut(address)
            && app.kinds != kinds
        {
            app.kinds = kinds;
            self.own_list_changed(now);
        }
    }

    fn app_ready(&mut self, now: Time, address: AppAddress) {
        if let Some(app) = self.apps.get_mut(address)
            && app.state != State::Ready
        {
            if app.wait().is_some() {
                // The root had been told all the same that it may start. It has been told nothing else.
                app.owed.append(&mut app.lost);
            }
            (app.state, app.ended) = (State::Ready, None);
            self.own_list_changed(now);
        }
    }

    /// It waits again for all that it requires; one that waits already was not started yet and goes on waiting.
    fn app_ended(&mut self, now: Time, address: AppAddress, how: Ended) {
        self.life_ended(now, address);
        let wait = Wait::begun(now, self.requirement_deadline);
        if let Some(app) = self.apps.get_mut(address)
            && app.wait().is_none()
        {
            // What it was told is lost stays until its next life begins, which has to hear the end of it.
            (app.state, app.ended) = (State::Waiting(wait), Some(how));
            app.silent.clear();
            app.phases.clear();
            let owed = std::mem::take(&mut app.owed);
            app.lost.extend(owed);
            // That it is met again was not taken, and that it is lost may have been.
            let not_taken = self.not_taken.iter().filter(|(other, _)| *other == address);
            app.lost.extend(not_taken.filter_map(|(_, name)| name.clone()));
            self.forget_not_taken(address);
            self.own_list_changed(now);
        }
    }

    /// What it waited for and wanted to hear it does not any more.
    fn life_ended(&mut self, now: Time, app: AppAddress) {
        self.rendezvous.ended(now, app);
        self.phases.ended(app);
        self.undelivered.forget(app);
        self.watchers.remove(app);
    }
}

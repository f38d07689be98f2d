//! Every change of this node's applications: it updates the registry, the routing table and the sync manager together.
//!
//! The registry's lock is held during all three updates, so that they see the changes of one address in one order.

mod commands;

pub use self::commands::register_command;
pub(crate) use self::commands::{claim_command, open_command, release_command};

use std::sync::Arc;

use sinew_model::{
    cause::Cause,
    facts::{AppFact, DeclaredTypes, NodeEvent, User},
    limits::EVENT_QUEUE_CAPACITY,
};
use sinew_runtime::{
    lock,
    monitor::DownClass,
    router::{LocalRoute, MessageSink},
    tid::{AppAddress, Tid},
    time::Time,
    wire::{Kind, Payload},
};

use super::core::{Address, Limits, Owner, RegisterError, Registry, Request};
use crate::State;

/// Reason for the end of an application in another process when LNCL ends.
pub(super) const LNCL_ENDED: &str = "its connection ended with its node's LNCL";

/// An application in the node's own process, as the root registers it.
pub struct LocalApp {
    /// Its name; `None` for an application with an address only.
    pub name: Option<String>,
    /// The fixed address that it requests; `None` for a dynamic one.
    pub address: Option<AppAddress>,
    /// The names that it requires.
    pub requires: Vec<String>,
    /// Names of the payload types that it handles, so that a collision of their ids is found.
    pub kinds: Vec<String>,
    /// The queue of its messages.
    pub sink: Arc<dyn MessageSink>,
    /// The layers' events that it subscribes to.
    pub events: Arc<[Kind]>,
}

/// Registers an application of the node's own process. Messages reach its sink from now on.
///
/// # Errors
/// The reason; nothing changed.
pub fn register_local(state: &State, app: LocalApp) -> Result<Tid, RegisterError> {
    register_own(state, app, Owner::Node)
}

fn register_own(state: &State, app: LocalApp, owner: Owner) -> Result<Tid, RegisterError> {
    let LocalApp { name, address, requires, kinds, sink, events } = app;
    let address = address.map_or(Address::Dynamic, Address::Fixed);
    let user = User::Own;
    let request = Request { address, name: name.clone(), requires, kinds, owner, user };
    let mut registry = lock(&state.registry);
    let fact_requires = request.requires.clone();
    let app = registry.register(request, limits(state))?;
    notify_access(state, app, name.as_deref(), user);
    let handled = events.to_vec();
    state.ctx.router.set_local(app, LocalRoute { sink, events });
    note_start(state, app, User::Own);
    notify_sync(state, AppFact::Registered { app, name, requires: fact_requires, user });
    notify_handled(state, app, handled);
    Ok(Tid::new(state.ctx.node, app))
}

fn limits(state: &State) -> Limits {
    let lncl = &state.ctx.config.lncl;
    Limits { apps: lncl.apps_max, clients: lncl.clients_max, per_process: lncl.clients_per_process_max }
}

/// Reports that the application has started and receives messages.
pub fn app_ready(state: &State, app: AppAddress) {
    let _registry = lock(&state.registry);
    notify(state, AppFact::Ready { app });
}

/// Reports that the application has failed and is not restarted yet. It keeps its address and its mailbox.
pub fn app_down(state: &State, app: AppAddress) {
    let _registry = lock(&state.registry);
    state.ctx.router.forget_retained(app);
    notify(state, AppFact::Down { app });
}

/// Reports that the application was stopped or has ended normally. It keeps its address.
pub fn app_stopped(state: &State, app: AppAddress) {
    let _registry = lock(&state.registry);
    state.ctx.router.forget_retained(app);
    notify(state, AppFact::Stopped { app });
}

/// Removes the registration of an application.
pub fn unregister_local(state: &State, app: AppAddress) {
    let mut registry = lock(&state.registry);
    if let Some(name) = registry.own_name_of(app) {
        state.commands.remove(&name);
    }
    if registry.unregister(app) {
        // Its supervisor has reported the reason before. An application that never started has no end to report.
        remove(state, app, Cause::new(DownClass::Shutdown, "it is not run any more"));
    }
}

/// Returns the current TID of `name`, on this node or another one.
pub fn resolve(state: &State, name: &str) -> Option<Tid> {
    let here = lock(&state.registry).resolve(name).map(|app| Tid::new(state.ctx.node, app));
    // The sync manager learns of changes on this node later, so it may still list a removed application.
    let is_elsewhere = |tid: &Tid| tid.node != state.ctx.node;
    // spec: SYNC-6
    here.or_else(|| state.ctx.ports.names()?.called(name).into_iter().find(is_elsewhere))
}

/// Returns names of applications, on any node, that are similar to `name`. They are compared without a lock.
pub fn nearest(state: &State, name: &str) -> Vec<String> {
    let names = state.ctx.ports.names().map_or_else(Vec::new, |names| names.all());
    sinew_model::nearest::nearest(name, names, String::as_str)
}

/// Makes `app` a member of `group`, or removes it. `app` is one of the node's own, in its process or in one that it
/// started. Has no effect if none of these has the address: such a request arrives after its application's end, and
/// would affect the next owner of the address.
pub fn set_member(state: &State, app: AppAddress, group: AppAddress, member: bool) {
    let registry = lock(&state.registry);
    if registry.owner_of(app) == Some(Owner::Node) {
        set_registered_member(state, &registry, app, group, member);
    }
}

/// Publishes the structures of the types of `app`. Has no effect if no application has the address, or if another one
/// has it by now: `is_current` returns whether the types are of the present one. It is called under the registry's
/// lock.
pub fn types_known(state: &State, app: AppAddress, types: DeclaredTypes, is_current: impl FnOnce() -> bool) {
    let registry = lock(&state.registry);
    if registry.owner_of(app).is_some() && is_current() {
        notify_sync(state, AppFact::Types { app, types });
    }
}

/// Same as [`set_member`], for any application. The caller holds the registry's lock, and has checked that the
/// application is registered.
pub(super) fn set_registered_member(
    state: &State,
    registry: &Registry,
    app: AppAddress,
    group: AppAddress,
    member: bool,
) {
    debug_assert!(registry.owner_of(app).is_some(), "nobody would end the membership");
    if state.ctx.router.set_member(group, app, member) && state.ctx.groups_need_notification() {
        notify_sync(state, AppFact::GroupsChanged);
    }
}

/// Number of waiting events of the sync manager from which on no client is registered. So a fast sequence of
/// registrations leaves room for the events of the layers.
const REGISTRATIONS_BELOW: usize = EVENT_QUEUE_CAPACITY / 2;

/// Registers an application of another process. No message reaches it before [`open`].
pub(super) fn register_client(state: &State, request: Request) -> Result<AppAddress, RegisterError> {
    let waiting = state.ctx.event_queues.sync.len();
    if waiting >= REGISTRATIONS_BELOW {
        return Err(RegisterError::Busy { waiting });
    }
    let (name, requires) = (request.name.clone(), request.requires.clone());
    let handled = request.kinds.iter().map(|name| Kind::named(name)).collect();
    let user = request.user;
    let mut registry = lock(&state.registry);
    let app = registry.register(request, limits(state))?;
    notify_access(state, app, name.as_deref(), user);
    note_start(state, app, user);
    notify_sync(state, AppFact::Registered { app, name, requires, user });
    notify_handled(state, app, handled);
    Ok(app)
}

/// Reports a registration to the access list, which has rules on names. The list knows the name, and the user of a
/// guest, before the application can send or receive. The caller holds the registry's lock, so the list forgets both
/// together with the registration.
fn notify_access(state: &State, app: AppAddress, name: Option<&str>, user: User) {
    let Some(access) = state.security.access.get() else { return };
    access.named(app, name);
    match user {
        User::Own => access.add_own(app),
        User::Guest(uid) => access.add_guest(app, uid),
    }
}

fn notify_handled(state: &State, app: AppAddress, kinds: Vec<Kind>) {
    if !kinds.is_empty() {
        notify_sync(state, AppFact::Handles { app, kinds });
    }
}

/// Opens the route: messages reach the application of another process from now on.
pub(super) fn open(state: &State, app: AppAddress, route: LocalRoute) {
    let registry = lock(&state.registry);
    if registry.owner_of(app).is_none() {
        // A later incarnation of LNCL's actor has removed it, since this one hung.
        return;
    }
    state.ctx.router.set_local(app, route);
    notify(state, AppFact::Ready { app });
}

/// Removes all applications of `owner`, which ended with this cause.
pub(super) fn remove_owner(state: &State, owner: Owner, cause: &Cause) {
    let mut registry = lock(&state.registry);
    for app in registry.remove_owner(owner) {
        remove(state, app, cause.clone());
    }
}

/// Removes the clients of an earlier instance of LNCL's actor. Their connections ended with it.
pub(super) fn remove_former_clients(state: &State) {
    let mut registry = lock(&state.registry);
    state.commands.release_all();
    for app in registry.in_other_processes() {
        registry.unregister(app);
        remove(state, app, Cause::new(DownClass::Killed, LNCL_ENDED));
    }
}

fn remove(state: &State, app: AppAddress, cause: Cause) {
    note_end(state, app, cause, true);
    // Reported before the route is removed, since the route holds its subscriptions.
    notify(state, AppFact::Unregistered { app });
    if let Some(types) = state.ctx.ports.app_types() {
        types.forget(app);
    }
    // After its types are forgotten: no refusal is set for the next owner of the address.
    state.ctx.router.remove_local(app);
    if let Some(access) = state.security.access.get() {
        access.remove(app);
    }
}

fn note_start(state: &State, app: AppAddress, user: User) {
    if let Some(app_lifecycle) = state.ctx.ports.app_lifecycle() {
        app_lifecycle.began(app, user);
    }
}

fn note_end(state: &State, app: AppAddress, cause: Cause, is_gone: bool) {
    if let Some(app_lifecycle) = state.ctx.ports.app_lifecycle() {
        app_lifecycle.ended(app, cause, is_gone);
    }
}

/// Notifies the sync manager, and also NDL if the application subscribes to node events.
fn notify(state: &State, fact: AppFact) {
    if let AppFact::Ready { app }
    | AppFact::Down { app }
    | AppFact::Stopped { app }
    | AppFact::Unregistered { app } = fact
        && state.ctx.router.subscribes(app, NodeEvent::KIND)
        && !state.ctx.app_backlogs.queue_for_ndl(&state.ctx.event_queues, fact.clone())
    {
        does_not_read(state, "NDL");
    }
    notify_sync(state, fact);
}

fn notify_sync(state: &State, fact: AppFact) {
    state.ctx.directory_has_changed();
    if !state.ctx.app_backlogs.queue_for_sync(&state.ctx.event_queues, fact) {
        does_not_read(state, "the sync manager");
    }
}

/// Logs that thousands of events wait for this layer, which has not read for long.
fn does_not_read(state: &State, layer: &str) {
    let what = format_args!("{layer} does not read its events: it receives changes of applications later");
    state.ctx.refusals.count(Time::now(), "a layer's event queue is full", &what);
}

#[cfg(test)]
mod tests {
    use futures_util::{FutureExt, StreamExt};
    use sinew_runtime::{
        mailbox::Mailbox,
        pending::{AppSink, Pending},
        tid::Incarnation,
    };

    use sinew_model::{config::NodeConfig, events::SyncEvent};

    use super::*;
    use crate::testing::PlayedNames;

    /// Registers an application of the node itself.
    fn registers(state: &State, name: Option<&str>, address: Option<AppAddress>) -> AppAddress {
        let sink = Arc::new(AppSink { pending: Pending::new(1), inbox: Mailbox::new(1) });
        let (name, events) = (name.map(str::to_owned), Arc::new([]));
        let app = LocalApp { name, address, requires: vec![], kinds: vec![], sink, events };
        register_local(state, app).expect("nothing is in the way").app
    }

    /// Registers a process of this user.
    fn client_registers(state: &State, address: Address, user: User) -> AppAddress {
        let owner = Owner::Client { id: lock(&state.registry).new_client(), pid: 1 };
        let request = Request { address, name: None, requires: vec![], kinds: vec![], owner, user };
        register_client(state, request).expect("nothing is in the way")
    }

    #[test]
    fn name_is_free_after_its_address_is_released() {
        // given: an application that the sync manager knows
        let state = State::for_test(NodeConfig::new("test"), Incarnation(1));
        let tid = Tid::new(state.ctx.node, registers(&state, Some("drive"), None));
        let names = Arc::new(PlayedNames::default());
        lock(&names.called).push(("drive".to_owned(), tid));
        state.ctx.ports.connect_names(&(names.clone() as Arc<_>));
        assert_eq!(resolve(&state, "drive"), Some(tid));
        // when
        unregister_local(&state, tid.app);
        // then: although the sync manager has not been notified
        assert_eq!(lock(&names.called).len(), 1);
        assert_eq!(resolve(&state, "drive"), None);
    }

    #[test]
    fn endless_joins_take_one_slot_at_the_sync_manager() {
        // given: a sync manager that reads nothing for now
        let state = State::for_test(NodeConfig::new("test"), Incarnation(1));
        let (app, group) = (registers(&state, None, None), AppAddress::group("drives"));
        let before = state.ctx.event_queues.sync.len();
        // when: there are more changes than its event queue has room for
        for turn in 0..=EVENT_QUEUE_CAPACITY {
            set_member(&state, app, group, turn % 2 == 0);
        }
        // then
        assert_eq!(state.ctx.event_queues.sync.len(), before + 1);
        // and: after it has checked, the next change is reported
        state.ctx.mark_groups_read();
        set_member(&state, app, group, false);
        assert_eq!(state.ctx.event_queues.sync.len(), before + 2);
    }

    #[test]
    fn join_after_its_applications_end_leaves_no_membership() {
        // given: an application of the node itself that was a member, and has ended
        let state = State::for_test(NodeConfig::new("test"), Incarnation(1));
        let (app, group) = (registers(&state, None, None), AppAddress::group("drives"));
        set_member(&state, app, group, true);
        assert!(state.ctx.router.is_member(group, app));
        unregister_local(&state, app);
        state.ctx.mark_groups_read();
        let before = state.ctx.event_queues.sync.len();
        // when
        set_member(&state, app, group, true);
        // then: and the sync manager has nothing to check
        assert_eq!((state.ctx.router.memberships(), state.ctx.event_queues.sync.len()), (0, before));
    }

    #[test]
    fn late_group_change_does_not_affect_a_new_guest() {
        // given: a guest at the address of an ended application of the node itself, and a member of one group
        let state = State::for_test(NodeConfig::new("test"), Incarnation(1));
        let app = registers(&state, None, Some(AppAddress::new(0x1001)));
        unregister_local(&state, app);
        client_registers(&state, Address::Fixed(app), User::Guest(1_001));
        let [drives, legs] = ["drives", "legs"].map(AppAddress::group);
        set_registered_member(&state, &lock(&state.registry), app, legs, true);
        // when
        set_member(&state, app, drives, true);
        set_member(&state, app, legs, false);
        // then
        assert_eq!([drives, legs].map(|group| state.ctx.router.is_member(group, app)), [false, true]);
    }

    #[test]
    fn registrations_wait_for_the_sync_manager_which_receives_all() {
        // given: a sync manager that reads nothing for now
        let state = State::for_test(NodeConfig::new("test"), Incarnation(1));
        let request = |pid| Request {
            address: Address::Dynamic,
            name: None,
            requires: vec![],
            kinds: vec![],
            owner: Owner::Client { id: lock(&state.registry).new_client(), pid },
            user: User::Own,
        };
        // when: processes register and end
        let mut registered = 0;
        let refused = loop {
            match register_client(&state, request(registered)) {
                Ok(app) => {
                    notify(&state, AppFact::Ready { app });
                    lock(&state.registry).unregister(app);
                    remove(&state, app, Cause::new(DownClass::Killed, LNCL_ENDED));
                    registered += 1;
                }
                Err(why) => break why,
            }
            assert!(
                usize::try_from(registered).unwrap() < EVENT_QUEUE_CAPACITY,
                "no registration is refused"
            );
        };
        // then
        assert!(matches!(refused, RegisterError::Busy { .. }), "{refused}");
        assert_eq!(
            state.ctx.event_queues.sync.len(),
            usize::try_from(3 * registered).unwrap(),
            "each change was reported"
        );
    }

    #[test]
    fn user_of_an_application_is_reported_with_its_registration() {
        // given, when: one of the robot's own applications and a guest register
        let state = State::for_test(NodeConfig::new("test"), Incarnation(1));
        let users = [User::Own, User::Guest(1_001)];
        let apps = users.map(|user| client_registers(&state, Address::Dynamic, user));
        // then
        let mut queue = state.ctx.event_queues.sync.attach();
        let events: Vec<_> = std::iter::from_fn(|| queue.next().now_or_never().flatten()).collect();
        let facts = events.iter().filter_map(|event| match event {
            SyncEvent::App(fact) => Some(fact.clone()),
            SyncEvent::Membership(_) | SyncEvent::Link(_) | SyncEvent::Message(_) | SyncEvent::Monitors => {
                None
            }
        });
        let registered = |of: usize| {
            let (app, user) = (apps[of], users[of]);
            AppFact::Registered { app, name: None, requires: vec![], user }
        };
        assert_eq!(facts.collect::<Vec<_>>(), [registered(0), registered(1)]);
    }

    #[test]
    fn access_list_knows_a_guest_while_it_is_registered() {
        // Given: an entry of a former holder of the address
        let state = State::for_test(NodeConfig::new("test"), Incarnation(1));
        let access = state.security.access_in_test(&state.ctx, "");
        let app = AppAddress::new(0x1001);
        access.add_guest(app, 1_001);
        let register = |user| client_registers(&state, Address::Fixed(app), user);
        // When, then: one of the robot's own applications has it
        register(User::Own);
        assert!(access.guests().is_empty());
        // And: a guest has it, until a later instance of LNCL takes it back
        remove_former_clients(&state);
        register(User::Guest(1_001));
        assert!(access.guests().contains(&app));
        remove_former_clients(&state);
        assert!(access.guests().is_empty());
    }

    #[test]
    fn group_change_without_room_is_reported_later() {
        // given: a full event queue
        let state = State::for_test(NodeConfig::new("test"), Incarnation(1));
        let (app, group) = (registers(&state, None, None), AppAddress::group("drives"));
        while state.ctx.event_queues.sync.post(SyncEvent::Monitors).is_ok() {}
        set_member(&state, app, group, true);
        // when
        let mut events = state.ctx.event_queues.sync.attach();
        let mut next = || events.next().now_or_never().flatten();
        assert!(matches!(next(), Some(SyncEvent::App(AppFact::Registered { .. }))));
        assert!(state.ctx.app_backlogs.offer_to_sync(&state.ctx.event_queues));
        // then
        let events = std::iter::from_fn(next).filter(|event| !matches!(event, SyncEvent::Monitors));
        let events: Vec<_> = events.collect();
        assert!(matches!(events[..], [SyncEvent::App(AppFact::GroupsChanged)]), "{events:?}");
    }
}

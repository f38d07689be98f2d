//! Every change of who is on this node: registry, routing table and sync manager are told together.
//!
//! The registry's lock is held over all three, so that they see the changes of one address in one order.

use std::sync::Arc;

use sinew_runtime::{
    monitor::DownClass,
    router::{LocalRoute, Outlet},
    tid::{AppAddress, Tid},
    time::Time,
    wire::{Kind, Payload},
};

use super::{
    AppFact,
    core::{Address, Limits, Owner, RegisterError, Registry, Request, User},
};
use crate::{
    monitors::{self, Cause},
    ndl::NodeEvent,
    stores::{POST_CAPACITY, Stores, lock},
};

/// Why an application of another process is gone when LNCL is.
pub(super) const LNCL_ENDED: &str = "its connection ended with its node's LNCL";

/// An application in the node's own process, as the root registers it.
pub(crate) struct LocalApp {
    /// Its name; `None` for an application that is known by its address alone.
    pub(crate) name: Option<String>,
    /// The fixed address that it wants; `None` for a dynamic one.
    pub(crate) address: Option<AppAddress>,
    /// The names that it requires.
    pub(crate) requires: Vec<String>,
    /// Names of the payload types that it handles, so that a collision of their ids is found.
    pub(crate) kinds: Vec<String>,
    /// What takes its messages.
    pub(crate) outlet: Arc<dyn Outlet>,
    /// The layers' events that it wants.
    pub(crate) events: Arc<[Kind]>,
}

/// Gives an application of the node's own process its address; messages reach its outlet from now on.
///
/// # Errors
/// Why not; nothing changed.
pub(crate) fn register_local(stores: &Stores, app: LocalApp) -> Result<Tid, RegisterError> {
    let LocalApp { name, address, requires, kinds, outlet, events } = app;
    let address = address.map_or(Address::Dynamic, Address::Fixed);
    let (owner, user) = (Owner::Node, User::Own);
    let request = Request { address, name: name.clone(), requires, kinds, owner, user };
    let mut registry = lock(&stores.registry);
    let fact_requires = request.requires.clone();
    let app = registry.register(request, limits(stores))?;
    tell_access(stores, app, name.as_deref(), user);
    let handled = events.to_vec();
    stores.router.set_local(app, LocalRoute { outlet, events });
    monitors::note(stores, monitors::Input::Began { app });
    tell_sync(stores, AppFact::Registered { app, name, requires: fact_requires, user });
    tell_handled(stores, app, handled);
    Ok(Tid::new(stores.node, app))
}

fn limits(stores: &Stores) -> Limits {
    let lncl = &stores.config.lncl;
    Limits { apps: lncl.apps_max, clients: lncl.clients_max, per_process: lncl.clients_per_process_max }
}

/// The application has started and takes messages.
pub(crate) fn app_ready(stores: &Stores, app: AppAddress) {
    let _registry = lock(&stores.registry);
    tell(stores, AppFact::Ready { app });
}

/// The application has failed and is not started again yet; it keeps its address and its mailbox.
pub(crate) fn app_down(stores: &Stores, app: AppAddress) {
    let _registry = lock(&stores.registry);
    tell(stores, AppFact::Down { app });
}

/// The application was stopped or has ended in order; it keeps its address.
pub(crate) fn app_stopped(stores: &Stores, app: AppAddress) {
    let _registry = lock(&stores.registry);
    tell(stores, AppFact::Stopped { app });
}

/// Takes the address of an application back.
pub(crate) fn unregister_local(stores: &Stores, app: AppAddress) {
    let mut registry = lock(&stores.registry);
    if registry.unregister(app) {
        // Its supervisor has said why before; who did not start has never lived.
        forget(stores, app, Cause::new(DownClass::Shutdown, "it is not run any more"));
    }
}

/// The TID that has `name` now, on this node or any.
pub(crate) fn resolve(stores: &Stores, name: &str) -> Option<Tid> {
    let here = lock(&stores.registry).resolve(name).map(|app| Tid::new(stores.node, app));
    // The sync manager hears of this node's later: it may still have one that is gone.
    let is_elsewhere = |tid: &Tid| tid.node != stores.node;
    // spec: SYNC-6
    here.or_else(|| lock(&stores.sync).called(name).into_iter().find(is_elsewhere))
}

/// Names of applications, on this node or any, that are similar to `name`. They are compared without a lock.
pub(crate) fn nearest(stores: &Stores, name: &str) -> Vec<String> {
    let names = lock(&stores.sync).names();
    crate::nearest::nearest(name, &names, |name| name).into_iter().map(ToString::to_string).collect()
}

/// Makes `app`, one of the node's own, in it or in a process that it started, a member of `group`, or no longer one. Nothing where none of
/// these has the address: such a word comes after its application's end, and would be whoever's who gets the address next.
pub(crate) fn set_member(stores: &Stores, app: AppAddress, group: AppAddress, member: bool) {
    let registry = lock(&stores.registry);
    if registry.owner_of(app) == Some(Owner::Node) {
        set_registered_member(stores, &registry, app, group, member);
    }
}

/// The same of any application, for who holds the registry's lock and has seen in it that the application is there.
pub(super) fn set_registered_member(
    stores: &Stores,
    registry: &Registry,
    app: AppAddress,
    group: AppAddress,
    member: bool,
) {
    debug_assert!(registry.owner_of(app).is_some(), "nobody would end the membership");
    if stores.router.set_member(group, app, member) && stores.groups_are_to_be_told() {
        tell_sync(stores, AppFact::GroupsChanged);
    }
}

/// So many events wait for the sync manager where no further process is registered: however fast somebody comes and goes, what layers have to
/// say finds room.
const REGISTRATIONS_BELOW: usize = POST_CAPACITY / 2;

/// Gives an application of another process its address. No message reaches it before [`open`].
pub(super) fn register_client(stores: &Stores, request: Request) -> Result<AppAddress, RegisterError> {
    let waiting = stores.posts.sync.len();
    if waiting >= REGISTRATIONS_BELOW {
        return Err(RegisterError::Busy { waiting });
    }
    let (name, requires) = (request.name.clone(), request.requires.clone());
    let handled = request.kinds.iter().map(|name| Kind::named(name)).collect();
    let user = request.user;
    let mut registry = lock(&stores.registry);
    let app = registry.register(request, limits(stores))?;
    tell_access(stores, app, name.as_deref(), user);
    let began = match user {
        User::Own => monitors::Input::Began { app },
        User::Guest(_) => monitors::Input::GuestBegan { app },
    };
    monitors::note(stores, began);
    tell_sync(stores, AppFact::Registered { app, name, requires, user });
    tell_handled(stores, app, handled);
    Ok(app)
}

/// The access list has rules about names: it knows one before whoever has it can send or get anything. So it does whose guest it is, and by
/// the lock that the caller holds it forgets that with the registration.
fn tell_access(stores: &Stores, app: AppAddress, name: Option<&str>, user: User) {
    let Some(access) = stores.access.get() else { return };
    access.named(app, name);
    match user {
        User::Own => access.own_came(app),
        User::Guest(uid) => access.guest_came(app, uid),
    }
}

fn tell_handled(stores: &Stores, app: AppAddress, kinds: Vec<Kind>) {
    if !kinds.is_empty() {
        tell_sync(stores, AppFact::Handles { app, kinds });
    }
}

/// Messages reach the application of another process from now on.
pub(super) fn open(stores: &Stores, app: AppAddress, route: LocalRoute) {
    let registry = lock(&stores.registry);
    if registry.owner_of(app).is_none() {
        // A later life of LNCL's actor has taken it back from this one, which hung.
        return;
    }
    stores.router.set_local(app, route);
    tell(stores, AppFact::Ready { app });
}

/// Takes back all that belongs to `owner`, which ended so.
pub(super) fn owner_gone(stores: &Stores, owner: Owner, cause: &Cause) {
    let mut registry = lock(&stores.registry);
    for app in registry.remove_owner(owner) {
        forget(stores, app, cause.clone());
    }
}

/// Takes back what an earlier life of LNCL's actor left: its connections ended with it.
pub(super) fn forget_former_clients(stores: &Stores) {
    let mut registry = lock(&stores.registry);
    for app in registry.in_other_processes() {
        registry.unregister(app);
        forget(stores, app, Cause::new(DownClass::Killed, LNCL_ENDED));
    }
}

fn forget(stores: &Stores, app: AppAddress, cause: Cause) {
    monitors::note(stores, monitors::Input::Ended { app, cause, is_gone: true });
    // Told first: afterwards nobody knows any more what it subscribed to.
    tell(stores, AppFact::Unregistered { app });
    stores.router.remove_local(app);
    if let Some(access) = stores.access.get() {
        access.gone(app);
    }
}

/// Tells the sync manager, and NDL where the application wants to know who is there.
fn tell(stores: &Stores, fact: AppFact) {
    if let AppFact::Ready { app }
    | AppFact::Down { app }
    | AppFact::Stopped { app }
    | AppFact::Unregistered { app } = fact
        && stores.router.subscribes(app, NodeEvent::KIND)
        && !stores.untold_of_apps.tell_ndl(&stores.posts, fact.clone())
    {
        does_not_read(stores, "NDL");
    }
    tell_sync(stores, fact);
}

fn tell_sync(stores: &Stores, fact: AppFact) {
    stores.directory_has_changed();
    if !stores.untold_of_apps.tell_sync(&stores.posts, fact) {
        does_not_read(stores, "the sync manager");
    }
}

/// Thousands of events wait for this layer, so it has stood still for long.
fn does_not_read(stores: &Stores, layer: &str) {
    let what =
        format_args!("{layer} does not read its events: it is told later what becomes of applications");
    stores.refusals.count(Time::now(), "a layer's post is full", &what);
}

#[cfg(test)]
mod standstill;
#[cfg(test)]
mod tests {
    use futures_util::{FutureExt, StreamExt};
    use sinew_runtime::{
        mailbox::Mailbox,
        pending::{AppOutlet, Pending},
        tid::Incarnation,
    };

    use super::*;
    use crate::{NodeConfig, access::Access, sync};

    /// One of the node's own registers.
    fn registers(stores: &Stores, name: Option<&str>, address: Option<AppAddress>) -> AppAddress {
        let outlet = Arc::new(AppOutlet { pending: Pending::new(1), inbox: Mailbox::new(1) });
        let (name, events) = (name.map(str::to_owned), Arc::new([]));
        let app = LocalApp { name, address, requires: vec![], kinds: vec![], outlet, events };
        register_local(stores, app).expect("nothing is in the way").app
    }

    /// A process of this user registers.
    fn client_registers(stores: &Stores, address: Address, user: User) -> AppAddress {
        let owner = Owner::Client { id: lock(&stores.registry).new_client(), pid: 1 };
        let request = Request { address, name: None, requires: vec![], kinds: vec![], owner, user };
        register_client(stores, request).expect("nothing is in the way")
    }

    #[test]
    fn a_name_is_free_when_its_address_is_given_back_whenever_the_sync_manager_hears_of_it() {
        // given: an application, of which the sync manager knows
        let stores = Stores::for_test(NodeConfig::new("test"), Incarnation(1));
        let tid = Tid::new(stores.node, registers(&stores, Some("drive"), None));
        let fact = AppFact::own_registered(tid.app, Some("drive".to_owned()), vec![]);
        lock(&stores.sync).handle(Time::ZERO, sync::Input::AppChanged(fact));
        assert_eq!(resolve(&stores, "drive"), Some(tid));
        // when
        unregister_local(&stores, tid.app);
        // then: though the sync manager has not heard of it
        assert_eq!(lock(&stores.sync).called("drive"), [tid]);
        assert_eq!(resolve(&stores, "drive"), None);
    }

    #[test]
    fn whoever_joins_and_leaves_without_end_takes_one_place_in_the_sync_managers_post() {
        // given: a sync manager that reads nothing for now
        let stores = Stores::for_test(NodeConfig::new("test"), Incarnation(1));
        let (app, group) = (registers(&stores, None, None), AppAddress::group("drives"));
        let before = stores.posts.sync.len();
        // when: more changes than its post has room for
        for turn in 0..=POST_CAPACITY {
            set_member(&stores, app, group, turn % 2 == 0);
        }
        // then
        assert_eq!(stores.posts.sync.len(), before + 1);
        // and when it has looked, the next change is told
        stores.groups_are_looked_at();
        set_member(&stores, app, group, false);
        assert_eq!(stores.posts.sync.len(), before + 2);
    }

    #[test]
    fn a_join_that_comes_after_its_applications_end_leaves_no_membership() {
        // given: one of the node's own that was a member, and has ended
        let stores = Stores::for_test(NodeConfig::new("test"), Incarnation(1));
        let (app, group) = (registers(&stores, None, None), AppAddress::group("drives"));
        set_member(&stores, app, group, true);
        assert!(stores.router.is_member(group, app));
        unregister_local(&stores, app);
        stores.groups_are_looked_at();
        let before = stores.posts.sync.len();
        // when
        set_member(&stores, app, group, true);
        // then: and the sync manager has nothing to look at
        assert_eq!((stores.router.memberships(), stores.posts.sync.len()), (0, before));
    }

    #[test]
    fn a_late_word_about_groups_changes_nothing_of_the_guest_that_has_the_address_now() {
        // given: a guest at the address of one of the node's own that has ended, and a member of one group
        let stores = Stores::for_test(NodeConfig::new("test"), Incarnation(1));
        let app = registers(&stores, None, Some(AppAddress::new(0x1001)));
        unregister_local(&stores, app);
        client_registers(&stores, Address::Fixed(app), User::Guest(1_001));
        let [drives, legs] = ["drives", "legs"].map(AppAddress::group);
        set_registered_member(&stores, &lock(&stores.registry), app, legs, true);
        // when
        set_member(&stores, app, drives, true);
        set_member(&stores, app, legs, false);
        // then
        assert_eq!([drives, legs].map(|group| stores.router.is_member(group, app)), [false, true]);
    }

    #[test]
    fn nobody_is_registered_faster_than_the_sync_manager_looks_and_of_those_who_are_it_hears_all() {
        // given: a sync manager that reads nothing for now
        let stores = Stores::for_test(NodeConfig::new("test"), Incarnation(1));
        let request = |pid| Request {
            address: Address::Dynamic,
            name: None,
            requires: vec![],
            kinds: vec![],
            owner: Owner::Client { id: lock(&stores.registry).new_client(), pid },
            user: User::Own,
        };
        // when: processes come and go
        let mut come_and_gone = 0;
        let refused = loop {
            match register_client(&stores, request(come_and_gone)) {
                Ok(app) => {
                    tell(&stores, AppFact::Ready { app });
                    lock(&stores.registry).unregister(app);
                    forget(&stores, app, Cause::new(DownClass::Killed, LNCL_ENDED));
                    come_and_gone += 1;
                }
                Err(why) => break why,
            }
            assert!(usize::try_from(come_and_gone).unwrap() < POST_CAPACITY, "nobody is refused");
        };
        // then
        assert!(matches!(refused, RegisterError::Busy { .. }), "{refused}");
        assert_eq!(
            stores.posts.sync.len(),
            usize::try_from(3 * come_and_gone).unwrap(),
            "each change was told"
        );
    }

    #[test]
    fn whose_an_application_is_is_told_with_its_registration() {
        // given, when: one of the robot's own and a guest come
        let stores = Stores::for_test(NodeConfig::new("test"), Incarnation(1));
        let users = [User::Own, User::Guest(1_001)];
        let apps = users.map(|user| client_registers(&stores, Address::Dynamic, user));
        // then
        let mut post = stores.posts.sync.attach();
        let told: Vec<_> = std::iter::from_fn(|| post.next().now_or_never().flatten()).collect();
        let facts = told.iter().filter_map(|event| match event {
            sync::Event::App(fact) => Some(fact.clone()),
            sync::Event::Membership(_)
            | sync::Event::Link(_)
            | sync::Event::Message(_)
            | sync::Event::Monitors => None,
        });
        let registered = |of: usize| {
            let (app, user) = (apps[of], users[of]);
            AppFact::Registered { app, name: None, requires: vec![], user }
        };
        assert_eq!(facts.collect::<Vec<_>>(), [registered(0), registered(1)]);
    }

    #[test]
    fn the_access_list_knows_a_guest_for_as_long_as_it_is_registered() {
        // Given: an entry of somebody who had the address
        let stores = Stores::for_test(NodeConfig::new("test"), Incarnation(1));
        let access = Access::in_test(&stores, "");
        let app = AppAddress::new(0x1001);
        access.guest_came(app, 1_001);
        let register = |user| client_registers(&stores, Address::Fixed(app), user);
        // When, then: one of the robot's own has it
        register(User::Own);
        assert!(access.guests().is_empty());
        // And: a guest has it, until a later life of LNCL takes it back
        forget_former_clients(&stores);
        register(User::Guest(1_001));
        assert!(access.guests().contains(&app));
        forget_former_clients(&stores);
        assert!(access.guests().is_empty());
    }

    #[test]
    fn a_change_of_groups_that_found_no_room_is_told_when_there_is_some() {
        // given: a post that is full
        let stores = Stores::for_test(NodeConfig::new("test"), Incarnation(1));
        let (app, group) = (registers(&stores, None, None), AppAddress::group("drives"));
        while stores.posts.sync.post(sync::Event::Monitors).is_ok() {}
        set_member(&stores, app, group, true);
        // when
        let mut post = stores.posts.sync.attach();
        let mut next = || post.next().now_or_never().flatten();
        assert!(matches!(next(), Some(sync::Event::App(AppFact::Registered { .. }))));
        assert!(stores.untold_of_apps.offer_to_sync(&stores.posts));
        // then
        let told = std::iter::from_fn(next).filter(|event| !matches!(event, sync::Event::Monitors));
        let told: Vec<_> = told.collect();
        assert!(matches!(told[..], [sync::Event::App(AppFact::GroupsChanged)]), "{told:?}");
    }
}

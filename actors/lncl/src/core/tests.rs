//! The rules of the registry.

use proptest::prelude::*;

use super::*;

const LIMITS: Limits = Limits { apps: 9, clients: 8, per_process: 4 };

fn request(address: Address, name: Option<&str>) -> Request {
    let name = name.map(str::to_owned);
    let (requires, kinds) = (Vec::new(), Vec::new());
    Request { address, name, requires, kinds, owner: Owner::Node, user: User::Own }
}

fn client(id: u64, pid: i32) -> Owner {
    Owner::Client { id: ClientId(id), pid }
}

fn fixed(index: u32) -> Address {
    Address::Fixed(AppAddress::fixed(index).unwrap())
}

#[test]
fn taken_name_is_refused_and_its_holder_named() {
    let mut registry = Registry::default();
    registry.register(request(fixed(1), Some("knee.sensor")), LIMITS).unwrap();
    let refusal = registry.register(request(Address::Dynamic, Some("knee.sensor")), LIMITS).unwrap_err();
    assert_eq!(
        refusal.to_string(),
        "the name 'knee.sensor' is taken by application 1001 of the node's own process; choose another name or \
         end that one first"
    );
}

#[test]
fn fixed_address_must_be_in_its_range_and_free() {
    let mut registry = Registry::default();
    for wrong in [AppAddress::NDL, AppAddress::NONE, AppAddress::dynamic(0).unwrap(), AppAddress::ALL] {
        let refusal = registry.register(request(Address::Fixed(wrong), None), LIMITS);
        assert_eq!(refusal, Err(RegisterError::NotFixed(wrong)));
    }
    registry.register(request(fixed(1), None), LIMITS).unwrap();
    let refusal = registry.register(request(fixed(1), None), LIMITS);
    assert!(matches!(refusal, Err(RegisterError::AddressTaken { .. })));
}

#[test]
fn unreadable_names_are_refused() {
    for name in [
        "",
        "line\nbreak",
        &"x".repeat(64),
        "a|b",
        "2 of drives",
        "leg.*",
        "left\u{202e}right",
        "10.0.0.2/1001",
    ] {
        let refusal = Registry::default().register(request(Address::Dynamic, Some(name)), LIMITS);
        assert!(matches!(refusal, Err(RegisterError::BadName { .. })), "{name:?}");
    }
}

#[test]
fn released_address_is_not_reused_at_once() {
    let mut registry = Registry::default();
    let first = registry.register(request(Address::Dynamic, None), LIMITS).unwrap();
    registry.unregister(first);
    assert_ne!(registry.register(request(Address::Dynamic, None), LIMITS), Ok(first));
}

#[test]
fn returning_application_gets_its_former_address_if_free() {
    let mut registry = Registry::default();
    let former = registry.register(request(Address::Dynamic, None), LIMITS).unwrap();
    registry.unregister(former);
    assert_eq!(registry.register(request(Address::Former(former), None), LIMITS), Ok(former));
    let other = registry.register(request(Address::Former(former), None), LIMITS).unwrap();
    assert!(other.is_dynamic() && other != former);
    let never_dynamic = registry.register(request(Address::Former(AppAddress::NDL), None), LIMITS).unwrap();
    assert!(never_dynamic.is_dynamic());
}

#[test]
fn dynamic_addresses_cycle_through_their_range() {
    let mut registry = Registry { next_dynamic: 0x6fff_ffff, ..Registry::default() };
    let last = registry.register(request(Address::Dynamic, None), LIMITS).unwrap();
    let first = registry.register(request(Address::Dynamic, None), LIMITS).unwrap();
    assert_eq!((last.bits(), first.bits()), (0xefff_ffff, 0x8000_0000));
}

#[test]
fn processes_with_unknown_pids_are_not_counted_as_one() {
    let mut registry = Registry::default();
    for _ in 0..=LIMITS.per_process {
        let owner = Owner::Client { id: registry.new_client(), pid: 0 };
        assert!(registry.register(Request { owner, ..request(Address::Dynamic, None) }, LIMITS).is_ok());
    }
}

#[test]
fn node_and_process_have_their_limits() {
    let mut registry = Registry::default();
    let mut register = |pid: i32, limits| {
        let owner = Owner::Client { id: registry.new_client(), pid };
        registry.register(Request { owner, ..request(Address::Dynamic, None) }, limits)
    };
    for _ in 0..LIMITS.per_process {
        register(7, LIMITS).unwrap();
    }
    assert_eq!(register(7, LIMITS), Err(RegisterError::ProcessFull { pid: 7, limit: LIMITS.per_process }));
    register(8, LIMITS).expect("another process has its own places");
    let clients = LIMITS.per_process + 1;
    assert_eq!(register(8, Limits { clients, ..LIMITS }), Err(RegisterError::ClientsFull { limit: clients }));
    assert_eq!(
        register(8, Limits { apps: clients, ..LIMITS }),
        Err(RegisterError::NodeFull { limit: clients })
    );
    let own = registry.register(request(Address::Dynamic, None), Limits { clients, ..LIMITS });
    assert!(own.is_ok(), "the node's own applications need no place of a client's");
}

/// Registers one more application of this user in another process, on a node with this limit of clients.
fn register_of(registry: &mut Registry, user: User, clients: usize) -> Result<AppAddress, RegisterError> {
    let ClientId(id) = registry.new_client();
    let limits = Limits { apps: 2 * clients, clients, per_process: clients };
    let owner = client(id, i32::try_from(id).unwrap());
    registry.register(Request { owner, user, ..request(Address::Dynamic, None) }, limits)
}

// spec: LNCL-13
#[test]
fn two_guest_users_share_half_of_the_slots() {
    let (mut registry, [first, second], third) = (Registry::default(), GUESTS, User::Guest(1003));
    // Given: one user at its limit
    let of_first = [(); 2].map(|()| register_of(&mut registry, first, 8).unwrap());
    let full = register_of(&mut registry, first, 8).unwrap_err();
    assert_eq!(full, RegisterError::GuestFull { uid: 1001, limit: 2 });
    for word in ["user 1001", " 2 ", "a quarter of `lncl.clients_max`", "end one, or raise it"] {
        assert!(full.to_string().contains(word), "{full}");
    }
    // When: another one is, too
    for _ in 0..2 {
        register_of(&mut registry, second, 8).unwrap();
    }
    // Then: a third one finds no slot, and the robot's own applications find the other half
    let full = register_of(&mut registry, third, 8).unwrap_err();
    assert_eq!(full, RegisterError::GuestsFull { limit: 4 });
    for word in [" 4 ", "half of `lncl.clients_max`", "end one, or raise it"] {
        assert!(full.to_string().contains(word), "{full}");
    }
    for _ in 0..4 {
        register_of(&mut registry, User::Own, 8).unwrap();
    }
    // And: the slot of a removed one is free for any user; if all are taken, the bound of all is named
    registry.unregister(of_first[0]);
    register_of(&mut registry, third, 8).unwrap();
    let full = register_of(&mut registry, User::Own, 8);
    assert_eq!(full, Err(RegisterError::ClientsFull { limit: 8 }));
}

#[test]
fn guest_finds_a_slot_on_a_small_node() {
    for clients in 1..4 {
        let mut registry = Registry::default();
        register_of(&mut registry, GUESTS[0], clients).expect("one at least");
        assert!(register_of(&mut registry, GUESTS[0], clients).is_err(), "of {clients}");
    }
}

/// These share their 32-bit FNV-1a, the best known pair of words that does: one is a type of the robot's, the other one
/// a guest's.
const ITS_OWN: &str = "liquid";
const A_GUESTS: &str = "costarring";
/// Two users that the access list admits.
const GUESTS: [User; 2] = [User::Guest(1001), User::Guest(1002)];

/// Registers an application that names this type.
fn register_naming(
    registry: &mut Registry,
    user: User,
    kind: &str,
    limits: Limits,
) -> Result<AppAddress, RegisterError> {
    let kinds = vec![kind.to_owned()];
    registry.register(Request { kinds, user, ..request(Address::Dynamic, None) }, limits)
}

// spec: LNCL-8
#[test]
fn two_payload_names_with_one_id_are_refused() {
    assert_eq!(Kind::named(A_GUESTS), Kind::named(ITS_OWN));
    let mut registry = Registry::default();
    let mut naming = |kind| register_naming(&mut registry, User::Own, kind, LIMITS);
    let first = naming(ITS_OWN).unwrap();
    naming(ITS_OWN).unwrap();
    assert!(matches!(naming(A_GUESTS), Err(RegisterError::KindCollision { .. })));
    // An id does not change its meaning after the end of the application that named it.
    registry.unregister(first);
    let refusal = register_naming(&mut registry, User::Own, A_GUESTS, LIMITS);
    assert!(matches!(refusal, Err(RegisterError::KindCollision { .. })));
}

// spec: LNCL-8
#[test]
fn two_names_with_one_id_bar_a_registration() {
    for user in [User::Own, GUESTS[0]] {
        let kinds = vec![A_GUESTS.to_owned(), ITS_OWN.to_owned()];
        let asked = Request { kinds, user, ..request(Address::Dynamic, None) };
        let refusal = Registry::default().register(asked, LIMITS);
        assert!(matches!(refusal, Err(RegisterError::KindCollision { .. })), "{user:?}");
    }
}

// spec: LNCL-8
#[test]
fn guest_types_with_own_ids_bar_no_own_application() {
    for stays in [true, false] {
        // Given: a guest has registered first
        let mut registry = Registry::default();
        let guest = register_naming(&mut registry, GUESTS[0], A_GUESTS, LIMITS).unwrap();
        assert_eq!(registry.kind_name(Kind::named(A_GUESTS)), Some(A_GUESTS));
        if !stays {
            registry.unregister(guest);
            assert_eq!(registry.kind_name(Kind::named(A_GUESTS)), None, "nothing is kept of him");
        }
        // When, then: the robot's own application registers, and its name counts
        register_naming(&mut registry, User::Own, ITS_OWN, LIMITS).unwrap();
        assert_eq!(registry.kind_name(Kind::named(A_GUESTS)), Some(ITS_OWN));
        // And: no guest with another name for the id is registered, not even the first one.
        for user in GUESTS {
            let refusal = register_naming(&mut registry, user, A_GUESTS, LIMITS);
            assert!(matches!(refusal, Err(RegisterError::KindCollision { .. })), "{user:?}");
            register_naming(&mut registry, user, ITS_OWN, LIMITS).expect("it is called so");
        }
    }
}

// spec: LNCL-8
#[test]
fn types_of_a_registered_guest_bind_its_user() {
    let mut registry = Registry::default();
    let first = register_naming(&mut registry, GUESTS[0], A_GUESTS, LIMITS).unwrap();
    let refusal = register_naming(&mut registry, GUESTS[0], ITS_OWN, LIMITS);
    assert!(matches!(refusal, Err(RegisterError::KindCollision { .. })));
    // A guest of another user is not bound by it.
    register_naming(&mut registry, GUESTS[1], ITS_OWN, LIMITS).unwrap();
    registry.unregister(first);
    register_naming(&mut registry, GUESTS[0], ITS_OWN, LIMITS).unwrap();
}

#[test]
fn kept_types_of_a_frequent_registrant_are_bounded() {
    let limits = Limits { apps: 2, ..LIMITS };
    for (user, most) in [(User::Own, (2 * 16, 0)), (GUESTS[0], (0, 1))] {
        let mut registry = Registry::default();
        for number in 0..100 {
            let name = format!("new.{number}");
            let app = register_naming(&mut registry, user, &name, limits).unwrap();
            let kept = registry.kinds.counts();
            assert!(kept.0 <= most.0 && kept.1 <= most.1, "{user:?}: {kept:?}");
            registry.unregister(app);
        }
        assert_eq!(registry.kinds.counts(), (most.0, 0), "{user:?}");
    }
}

#[test]
fn root_and_the_nodes_own_user_are_no_guests() {
    let of = |uid| User::of(uid, 1000);
    assert_eq!([of(1000), of(0), of(1001)], [User::Own, User::Own, User::Guest(1001)]);
    assert_eq!(User::of(1000, 0), User::Guest(1000), "of a node that runs as root");
}

#[derive(Clone, Debug)]
enum Step {
    Register { fixed: Option<u32>, name: Option<u8>, owner: u64 },
    Unregister(u32),
    ClientGone(u64),
}

fn any_step() -> impl Strategy<Value = Step> {
    prop_oneof![
        (proptest::option::of(0u32..6), proptest::option::of(0u8..6), 0u64..4)
            .prop_map(|(fixed, name, owner)| Step::Register { fixed, name, owner }),
        (0u32..6).prop_map(Step::Unregister),
        (1u64..4).prop_map(Step::ClientGone),
    ]
}

fn owner_of(number: u64) -> Owner {
    if number == 0 { Owner::Node } else { client(number, number as i32) }
}

proptest! {
    #[test]
    fn names_and_addresses_have_one_holder_through_any_history(
        steps in proptest::collection::vec(any_step(), 0..60),
    ) {
        let mut registry = Registry::default();
        for step in steps {
            match step {
                Step::Register { fixed: index, name, owner } => {
                    let before = registry.len();
                    let address = index.map_or(Address::Dynamic, fixed);
                    let name = name.map(|n| n.to_string());
                    let asked = Request { owner: owner_of(owner), ..request(address, name.as_deref()) };
                    let grown = usize::from(registry.register(asked, Limits { apps: 10, ..LIMITS }).is_ok());
                    prop_assert_eq!(registry.len(), before + grown);
                }
                Step::Unregister(index) => {
                    registry.unregister(AppAddress::fixed(index).unwrap());
                }
                Step::ClientGone(number) => {
                    registry.remove_owner(owner_of(number));
                    prop_assert!(registry.owned_by(|owner| owner == owner_of(number)).is_empty());
                }
            }
            prop_assert!(registry.len() <= 10);
            let named: Vec<_> = registry.apps.values().filter_map(|entry| entry.name.clone()).collect();
            prop_assert_eq!(named.len(), registry.names.len());
            for (name, app) in &registry.names {
                prop_assert_eq!(registry.apps[app].name.as_ref(), Some(name));
            }
        }
    }
}

proptest! {
    // spec: LNCL-13
    #[test]
    fn own_applications_always_find_half_of_the_slots(
        clients in 2_usize..40,
        // The user that registers, or else the present application that ends.
        steps in proptest::collection::vec(
            (proptest::option::of(0_u32..5), any::<proptest::sample::Index>()),
            0..120,
        ),
    ) {
        let (mut registry, mut here) = (Registry::default(), Vec::new());
        for (comes, which) in steps {
            if let Some(number) = comes {
                let user = if number == 0 { User::Own } else { User::Guest(1_000 + number) };
                here.extend(register_of(&mut registry, user, clients).ok().map(|app| (app, user)));
            } else if !here.is_empty() {
                let (app, _) = here.swap_remove(which.index(here.len()));
                prop_assert!(registry.unregister(app));
            }
            let guests = here.iter().filter(|(_, user)| *user != User::Own).count();
            prop_assert!(guests <= clients / 2, "{guests} of {clients}");
            for number in 1..5 {
                let is_this = |user: User| user == User::Guest(1_000 + number);
                let of_user = here.iter().filter(|(_, user)| is_this(*user)).count();
                prop_assert!(of_user <= (clients / 4).max(1), "{of_user} of {clients}");
            }
        }
        // With any applications present, the robot's own have, or get, at least half of all slots.
        let mut own = here.iter().filter(|(_, user)| *user == User::Own).count();
        while own < clients - clients / 2 {
            prop_assert!(register_of(&mut registry, User::Own, clients).is_ok(), "{own} of {clients}");
            own += 1;
        }
    }
}

#[test]
fn empty_requirement_is_refused_with_a_reason() {
    let mut registry = Registry::default();
    let asked = Request { requires: vec!["0 of knee".to_owned()], ..request(fixed(1), Some("hip")) };
    let refused = registry.register(asked, LIMITS).unwrap_err();
    assert!(refused.to_string().contains("0 of something is no requirement"), "{refused}");
}

//! The payload types of the applications of this node: Rust types of its own process, and declarations of other
//! processes.

use std::{
    collections::{BTreeMap, BTreeSet},
    sync::{Arc, Mutex},
};

use sinew_model::facts::{DeclaredTypes, TypeDeclaration, User};
use sinew_runtime::{
    lock,
    tid::AppAddress,
    wire::{Kind, PayloadType, SchemaHash},
};

use super::{
    app_type::{AppType, DeclaredType, Structure},
    verdicts::Program,
};

/// Maximum number of types that one application handles, and of those that it sends; the directory has as many.
/// Further ones are not compared.
const TYPES_MAX: usize = 64;
/// Maximum bytes of the structures that one application in another process declares. A structure of twenty fields has
/// some 300 bytes.
const APP_BYTES_MAX: usize = 64 * 1024;
/// Maximum bytes of those that all such applications declare: of the node's own user, and of guests.
const OWN_BYTES_MAX: usize = 1 << 20;
const GUEST_BYTES_MAX: usize = 128 * 1024;
/// Prefix of the names of Sinew's own types. Layers send and handle them, and keep them compatible.
const OWN_PREFIX: &str = "sinew.";

/// The types of all applications, and the applications with types that the directory does not have yet.
#[derive(Debug, Default)]
pub(super) struct Declared(Mutex<Table>);

#[derive(Debug, Default)]
struct Table {
    apps: BTreeMap<AppAddress, AppTypes>,
    changed: BTreeSet<AppAddress>,
    /// The number of the last registration of an application with types.
    registrations: u64,
}

/// The types of one application.
#[derive(Clone, Debug, Default)]
pub(super) struct AppTypes {
    handles: Vec<AppType>,
    sends: Vec<AppType>,
    /// The user of the other process that declared them; `None`: they are types of this process.
    declared_by: Option<User>,
    /// The bytes of these declarations.
    bytes: usize,
    /// The number of the registration. Another application with this address has another one.
    pub(super) registration: u64,
}

impl Table {
    /// Adds an application, in the place of a former owner of the address.
    fn insert(&mut self, app: AppAddress, types: AppTypes) -> &mut AppTypes {
        self.registrations += 1;
        let types = AppTypes { registration: self.registrations, ..types };
        // The entry that follows is the one that was just inserted.
        self.apps.insert(app, types);
        self.apps.entry(app).or_default()
    }

    /// Returns the bytes that the applications of all guests, or of the node's own user, have declared.
    fn bytes_of(&self, user: User) -> usize {
        let is_guest = |user: User| matches!(user, User::Guest(_));
        let of_such = self.apps.values().filter(|app| app.declared_by.map(is_guest) == Some(is_guest(user)));
        of_such.map(|app| app.bytes).sum()
    }
}

impl Declared {
    /// Records the types of a registered application of this process. It replaces a former owner of the address.
    pub(super) fn register(&self, app: AppAddress, handles: &[PayloadType], sends: &[PayloadType]) {
        let mut types = AppTypes::default();
        let own = |one: &&PayloadType| !one.name().starts_with(OWN_PREFIX);
        handles.iter().filter(own).for_each(|one| _ = add(&mut types.handles, &AppType::Own(*one)));
        sends.iter().filter(own).for_each(|one| _ = add(&mut types.sends, &AppType::Own(*one)));
        let mut table = lock(&self.0);
        table.insert(app, types);
        table.changed.insert(app);
    }

    /// Records that the application sends a type of this process. Returns whether that is new. An application without a
    /// registration is ignored.
    pub(super) fn sends(&self, app: AppAddress, sent: PayloadType) -> bool {
        if sent.name().starts_with(OWN_PREFIX) {
            return false;
        }
        let mut table = lock(&self.0);
        let types = table.apps.get_mut(&app);
        let is_new = types.is_some_and(|types| add(&mut types.sends, &AppType::Own(sent)));
        if is_new {
            table.changed.insert(app);
        }
        is_new
    }

    /// Records a type of a registered application in another process. Its bytes are read later, by the thread.
    ///
    /// # Errors
    /// The declaration is not valid, or there is no room for it.
    pub(super) fn declare(
        &self,
        app: AppAddress,
        user: User,
        declaration: TypeDeclaration,
    ) -> Result<(), String> {
        let (handles, sends) = (declaration.handles, declaration.sends);
        let one = DeclaredType::new(declaration)?;
        let (kind, bytes) = (one.kind(), one.bytes());
        let mut table = lock(&self.0);
        let all_max = if user == User::Own { OWN_BYTES_MAX } else { GUEST_BYTES_MAX };
        let of_all = table.bytes_of(user);
        let is_there = table.apps.get(&app).is_some_and(|types| types.declared_by == Some(user));
        let types = if is_there {
            table.apps.entry(app).or_default()
        } else {
            table.insert(app, AppTypes { declared_by: Some(user), ..AppTypes::default() })
        };
        if types.bytes + bytes > APP_BYTES_MAX || of_all + bytes > all_max {
            return Err(format!(
                "it declares kind {kind} by {bytes} bytes, behind {} of its own and {of_all} of all such \
                 applications; {APP_BYTES_MAX} and {all_max} have room, and messages of the type are not compared",
                types.bytes
            ));
        }
        let one = AppType::Declared(Arc::new(one));
        let is_handled = handles && add(&mut types.handles, &one);
        let is_sent = sends && add(&mut types.sends, &one);
        if is_handled || is_sent {
            types.bytes += bytes;
            table.changed.insert(app);
        } else if !(types.handles.contains(&one) || types.sends.contains(&one)) {
            return Err(format!(
                "it declares kind {kind} behind {TYPES_MAX} types that it handles or sends, or as neither"
            ));
        }
        Ok(())
    }

    /// Removes one application from those with changes, and returns it.
    pub(super) fn pop_changed(&self) -> Option<(AppAddress, AppTypes)> {
        let mut table = lock(&self.0);
        while let Some(app) = table.changed.pop_first() {
            if let Some(types) = table.apps.get(&app) {
                return Some((app, types.clone()));
            }
        }
        None
    }

    /// Removes an application that is not registered.
    pub(super) fn forget(&self, app: AppAddress) {
        let mut table = lock(&self.0);
        table.apps.remove(&app);
        table.changed.remove(&app);
    }

    /// Returns whether the application with this address has this number of a registration.
    pub(super) fn is_current(&self, app: AppAddress, registration: u64) -> bool {
        lock(&self.0).apps.get(&app).is_some_and(|types| types.registration == registration)
    }

    /// Returns whether an application in another process has declared types.
    pub(super) fn has_declarations(&self) -> bool {
        lock(&self.0).apps.values().any(|types| types.declared_by.is_some())
    }

    /// Returns the program of an application of this node.
    pub(super) fn program(&self, app: AppAddress) -> Program {
        let declared_by = lock(&self.0).apps.get(&app).and_then(|types| types.declared_by);
        match declared_by {
            None => Program::Node,
            Some(User::Own) => Program::Other,
            Some(User::Guest(_)) => Program::Guest,
        }
    }

    /// Returns the type of this kind that the application handles. `None`: none, or several with different structures.
    pub(super) fn handled(&self, app: AppAddress, kind: Kind) -> Option<AppType> {
        let of = of_kind(&lock(&self.0).apps.get(&app)?.handles, kind);
        // Without the lock: each type may be traced.
        is_one(&of).then(|| of.first().cloned())?
    }

    /// Returns the type of this kind that the application sends. `None`: none, or several with different structures.
    pub(super) fn sent(&self, app: AppAddress, kind: Kind) -> Option<AppType> {
        let of = of_kind(&lock(&self.0).apps.get(&app)?.sends, kind);
        is_one(&of).then(|| of.first().cloned())?
    }

    /// Returns the structure with this hash that a process has declared for a type. Those of guests are last: a
    /// structure with the hash of another one can be constructed.
    pub(super) fn schema_of_hash(&self, kind: Kind, hash: SchemaHash) -> Option<Structure> {
        let [own, guests] = [false, true].map(|of_guests| self.declared_of(kind, of_guests));
        let mut structures = own.into_iter().chain(guests).filter_map(|one| one.schema());
        structures.find(|(_, other)| *other == hash).map(|(structure, _)| structure)
    }

    /// Returns a structure that a process of the node's own user has declared for a type. That of a guest is none: it
    /// would be taken for messages of other applications, too.
    pub(super) fn schema_of(&self, kind: Kind) -> Option<Structure> {
        self.declared_of(kind, false).into_iter().find_map(|one| one.schema()).map(|(structure, _)| structure)
    }

    /// Returns the declarations of a type by other processes: of guests, or of the node's own user.
    fn declared_of(&self, kind: Kind, of_guests: bool) -> Vec<AppType> {
        let is_of = |user: User| matches!(user, User::Guest(_)) == of_guests;
        let table = lock(&self.0);
        let apps = table.apps.values().filter(|types| types.declared_by.is_some_and(is_of));
        let all = apps.flat_map(|types| types.handles.iter().chain(&types.sends));
        all.filter(|one| one.kind() == kind).cloned().collect()
    }
}

impl AppTypes {
    /// Traces the types. It may take milliseconds for each, at the first time. Two Rust types of one name and different
    /// structures are left out: nobody knows which of them a message is of.
    pub(super) fn hashes(&self) -> DeclaredTypes {
        let known = |types: &[AppType]| {
            let firsts =
                types.iter().enumerate().filter(|(at, one)| of_kind(&types[..*at], one.kind()).is_empty());
            let alone = firsts.filter(|(_, one)| is_one(&of_kind(types, one.kind())));
            alone.filter_map(|(_, one)| Some((one.kind(), one.hash()?))).collect()
        };
        DeclaredTypes { handles: known(&self.handles), sends: known(&self.sends) }
    }

    /// Returns the types with declarations that cannot be read.
    pub(super) fn invalid(&self) -> BTreeSet<Kind> {
        let all = self.handles.iter().chain(&self.sends);
        all.filter(|one| one.is_invalid()).map(AppType::kind).collect()
    }

    /// Returns whether the application has two types of one name. Its published types may become fewer by that.
    pub(super) fn has_two_of_a_kind(&self) -> bool {
        let has_two = |types: &[AppType]| types.iter().any(|one| of_kind(types, one.kind()).len() > 1);
        has_two(&self.handles) || has_two(&self.sends)
    }
}

/// Adds a type unless it is there. Returns whether it was added.
fn add(types: &mut Vec<AppType>, one: &AppType) -> bool {
    let is_new = types.len() < TYPES_MAX && !types.contains(one);
    if is_new {
        types.push(one.clone());
    }
    is_new
}

fn of_kind(types: &[AppType], kind: Kind) -> Vec<AppType> {
    types.iter().filter(|one| one.kind() == kind).cloned().collect()
}

/// Returns whether all these types have one structure.
fn is_one(types: &[AppType]) -> bool {
    match types {
        [] | [_] => true,
        [first, others @ ..] => others.iter().all(|other| other.hash() == first.hash()),
    }
}

#[cfg(test)]
mod tests {
    use serde::{Deserialize, Serialize};
    use sinew_runtime::{
        app::{AppContext, AppSpec, DynApp},
        wire::{MismatchPolicy, Payload},
    };
    use sinew_schema::{SCHEMA_BYTES_MAX, Schema};

    use super::*;

    const APP: AppAddress = AppAddress::new(0x1000);

    #[derive(Serialize, Deserialize)]
    struct Angle {
        degrees: f32,
    }

    impl Payload for Angle {
        const NAME: &'static str = "test.declared.angle";
    }

    #[derive(Serialize, Deserialize)]
    struct Speed {
        value: f32,
    }

    impl Payload for Speed {
        const NAME: &'static str = "test.declared.speed";
    }

    #[derive(Serialize, Deserialize)]
    struct Own {}

    impl Payload for Own {
        const NAME: &'static str = "sinew.test.declared";
    }

    /// Another Rust type with the name of the first.
    #[derive(Serialize, Deserialize)]
    struct OtherAngle {
        radians: f32,
    }

    impl Payload for OtherAngle {
        const NAME: &'static str = Angle::NAME;
    }

    struct Gait;

    impl actix::Actor for Gait {
        type Context = AppContext<Self>;
    }

    fn gait() -> DynApp {
        AppSpec::new("gait", || Gait).sends::<Angle>().sends::<Own>().sends::<Speed>().into()
    }

    #[test]
    fn sent_types_are_published_once_without_those_of_sinew() {
        let (declared, gait) = (Declared::default(), gait());
        let [angle, _, speed] = gait.sends() else { panic!("it sends three") };
        assert!(!declared.sends(APP, *angle), "nothing has this address");
        declared.register(APP, &[], &[*angle]);
        assert!(!declared.sends(APP, *angle) && declared.sends(APP, *speed));
        let (app, types) = declared.pop_changed().expect("one has changed");
        let sends = types.hashes().sends;
        assert_eq!((app, sends.len()), (APP, 2));
        assert_eq!(sends[0], (Angle::KIND, angle.schema().unwrap().hash()));
        assert!(declared.pop_changed().is_none());
        assert_eq!(declared.sent(APP, Speed::KIND), Some(AppType::Own(*speed)));
        declared.register(APP, &[*angle], gait.sends());
        assert_eq!(declared.sent(APP, Own::KIND), None);
        assert_eq!(declared.handled(APP, Angle::KIND), Some(AppType::Own(*angle)));
        declared.forget(APP);
        assert!(declared.sent(APP, Speed::KIND).is_none() && declared.pop_changed().is_none());
    }

    #[test]
    fn two_structures_of_one_name_are_not_published() {
        let declared = Declared::default();
        let app: DynApp =
            AppSpec::new("gait", || Gait).sends::<Angle>().sends::<Speed>().sends::<OtherAngle>().into();
        let [angle, speed, other] = app.sends() else { panic!("it sends three") };
        declared.register(APP, &[], &[*angle, *speed]);
        assert_eq!(declared.pop_changed().map(|(_, types)| types.hashes().sends.len()), Some(2));
        assert!(declared.sends(APP, *other), "it is another type");
        let (_, types) = declared.pop_changed().expect("it has changed");
        assert!(types.has_two_of_a_kind());
        let kinds: Vec<_> = types.hashes().sends.into_iter().map(|(kind, _)| kind).collect();
        assert_eq!(kinds, [Speed::KIND]);
        let speed = Some(AppType::Own(*speed));
        assert_eq!((declared.sent(APP, Angle::KIND), declared.sent(APP, Speed::KIND)), (None, speed));
    }

    const CLIENT: AppAddress = AppAddress::new(0x8000_0001);

    /// Returns the declaration of a type that a client sends, with these bytes.
    fn declaration(kind: Kind, schema: Vec<u8>) -> TypeDeclaration {
        let policy = "warn".to_owned();
        TypeDeclaration { kind, handles: false, sends: true, policy, protected: false, schema }
    }

    fn angle_bytes() -> Vec<u8> {
        Schema::of::<Angle>().unwrap().encode()
    }

    #[test]
    fn declared_type_is_published_until_its_client_ends() {
        let (declared, schema) = (Declared::default(), Schema::of::<Angle>().unwrap());
        assert_eq!(declared.declare(CLIENT, User::Own, declaration(Angle::KIND, angle_bytes())), Ok(()));
        let (app, types) = declared.pop_changed().expect("it has changed");
        assert_eq!((app, types.hashes().sends), (CLIENT, vec![(Angle::KIND, schema.hash())]));
        assert!(
            declared.is_current(CLIENT, types.registration) && declared.program(CLIENT) == Program::Other
        );
        let found = declared.schema_of_hash(Angle::KIND, schema.hash()).expect("it was declared");
        assert_eq!((&*found, declared.schema_of(Speed::KIND).is_some()), (&schema, false));
        assert_eq!(declared.sent(CLIENT, Angle::KIND).map(|one| one.policy()), Some(MismatchPolicy::Warn));
        // Again: nothing has changed.
        assert_eq!(declared.declare(CLIENT, User::Own, declaration(Angle::KIND, angle_bytes())), Ok(()));
        assert!(declared.pop_changed().is_none());
        declared.forget(CLIENT);
        assert!(!declared.is_current(CLIENT, types.registration) && !declared.has_declarations());
        assert!(declared.schema_of_hash(Angle::KIND, schema.hash()).is_none());
        assert_eq!(declared.declare(CLIENT, User::Own, declaration(Angle::KIND, angle_bytes())), Ok(()));
        assert!(!declared.is_current(CLIENT, types.registration), "it is another registration");
    }

    #[test]
    fn invalid_bytes_are_no_structure() {
        let declared = Declared::default();
        for bytes in [vec![], vec![0; 9], [angle_bytes(), vec![0]].concat()] {
            assert_eq!(declared.declare(CLIENT, User::Own, declaration(Angle::KIND, bytes)), Ok(()));
            let (_, types) = declared.pop_changed().expect("it has changed");
            assert!(types.hashes().is_empty() && types.invalid().contains(&Angle::KIND));
            assert!(declared.schema_of(Angle::KIND).is_none());
            declared.forget(CLIENT);
        }
        let of_layer = declaration(Kind::LNCL_REGISTER, angle_bytes());
        assert!(declared.declare(CLIENT, User::Own, of_layer).is_err());
        let too_long = declaration(Angle::KIND, vec![0; SCHEMA_BYTES_MAX + 1]);
        assert!(declared.declare(CLIENT, User::Own, too_long).is_err());
        let unused = TypeDeclaration { sends: false, ..declaration(Angle::KIND, angle_bytes()) };
        assert!(declared.declare(CLIENT, User::Own, unused).is_err());
    }

    #[test]
    fn declarations_are_bounded_in_number_and_bytes() {
        let kind = |n: usize| Kind::named(&n.to_string());
        let app = |n: usize| AppAddress::dynamic(n as u32).expect("it is in the range");
        let declared = Declared::default();
        for n in 0..TYPES_MAX {
            assert_eq!(declared.declare(app(0), User::Own, declaration(kind(n), angle_bytes())), Ok(()));
        }
        let refused = declared.declare(app(0), User::Own, declaration(kind(TYPES_MAX), angle_bytes()));
        assert!(refused.is_err_and(|why| why.contains("behind 64 types")));
        // Of one application:
        let long = |n: usize| declaration(kind(n), vec![0; SCHEMA_BYTES_MAX]);
        let of_app = APP_BYTES_MAX / SCHEMA_BYTES_MAX;
        (0..of_app).for_each(|n| assert_eq!(declared.declare(app(1), User::Own, long(n)), Ok(())));
        let refused = declared.declare(app(1), User::Own, long(of_app));
        assert!(refused.is_err_and(|why| why.contains("have room")));
        // Of all guests: it takes no room from the node's own user.
        let count = GUEST_BYTES_MAX / SCHEMA_BYTES_MAX;
        for n in 0..count {
            assert_eq!(declared.declare(app(2 + n), User::Guest(1_001), long(0)), Ok(()));
        }
        assert!(declared.declare(app(2 + count), User::Guest(1_002), long(0)).is_err());
        assert_eq!(declared.declare(app(2 + count), User::Own, long(0)), Ok(()));
        declared.forget(app(2));
        assert_eq!(declared.declare(app(3 + count), User::Guest(1_002), long(0)), Ok(()));
    }
}

//! Known definitions of messages and services, and types made of them.

use std::{collections::BTreeMap, fmt, sync::Arc};

use crate::{
    definition::{Base, Definition, DefinitionError, Field, parse_message, parse_service},
    name::{NameError, TypeName},
};

/// Maximum number of definitions.
const DEFINITIONS_MAX: usize = 1_024;
/// Maximum depth of messages in messages.
const DEPTH_MAX: usize = 16;
/// Maximum members of a type, with those of all messages in it: a type that doubles itself at each level ends here.
const MEMBERS_MAX: usize = 4_096;

/// The definitions that are shipped.
const SHIPPED: &str = include_str!("shipped.txt");

/// How many values a member has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Count {
    /// One value.
    One,
    /// This number of values.
    Array(u32),
    /// At most this number of values.
    Bounded(u32),
    /// Any number of values.
    Unbounded,
}

/// The type of one value.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Element {
    /// `bool`
    Bool,
    /// `byte`: a `uint8` with another number in type descriptions.
    Byte,
    /// `int8` to `int64`, with its bits.
    Signed(u8),
    /// `uint8` to `uint64`, with its bits.
    Unsigned(u8),
    /// `float32` or `float64`, with its bits.
    Float(u8),
    /// `string`, with its maximum bytes; `None`: without a limit.
    Text(Option<u32>),
    /// Another message.
    Message(Arc<Structure>),
}

/// A message type with all types in it, or one half of a service.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Structure {
    /// Its name.
    pub name: TypeName,
    /// Its members, in their order on the wire.
    pub members: Vec<Member>,
}

/// A member of a message.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Member {
    /// Its name.
    pub name: String,
    /// The type of each value.
    pub element: Element,
    /// How many values it has.
    pub count: Count,
}

/// The two halves of a service, and the structure by which its hash is made.
#[derive(Clone, Debug)]
pub struct Service {
    /// Its name.
    pub name: TypeName,
    /// The request.
    pub request: Arc<Structure>,
    /// The response.
    pub response: Arc<Structure>,
    /// Request, response and event as the members of one structure: its hash is that of the service.
    pub description: Arc<Structure>,
}

/// A type that cannot be made.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum CatalogError {
    /// The name is no name of a type.
    Name(NameError),
    /// The text is no definition.
    Definition(DefinitionError),
    /// There is no definition of this name.
    Unknown {
        /// The name.
        name: TypeName,
        /// The message that refers to it, if one does.
        by: Option<TypeName>,
    },
    /// A message is in itself, or nested too deeply, or has too many members.
    Nested(TypeName),
    /// There are too many definitions.
    Full,
}

impl fmt::Display for CatalogError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Name(why) => write!(f, "{why}"),
            Self::Definition(why) => write!(f, "{why}"),
            Self::Unknown { name, by } => {
                write!(f, "{name} is not known")?;
                if let Some(by) = by {
                    write!(f, ", and {by} refers to it")?;
                }
                f.write_str("; put its definition into the folder `messages`")
            }
            Self::Nested(name) => write!(
                f,
                "{name} is in itself, or has more than {DEPTH_MAX} levels or {MEMBERS_MAX} members; use a smaller type"
            ),
            Self::Full => {
                write!(f, "there are more than {DEFINITIONS_MAX} definitions; keep only those that are used")
            }
        }
    }
}

impl std::error::Error for CatalogError {}

impl From<NameError> for CatalogError {
    fn from(error: NameError) -> Self {
        Self::Name(error)
    }
}

impl From<DefinitionError> for CatalogError {
    fn from(error: DefinitionError) -> Self {
        Self::Definition(error)
    }
}

/// Known definitions of messages and services.
///
/// # Examples
///
/// ```
/// use sinew_ros2_core::{Catalog, type_hash};
///
/// let mut catalog = Catalog::shipped();
/// catalog.add("demo_msgs/msg/Angle", "float64 degrees")?;
/// let angle = catalog.message("demo_msgs/msg/Angle")?;
/// assert_eq!(angle.members[0].name, "degrees");
/// assert!(type_hash(&angle).starts_with("RIHS01_"));
/// # Ok::<(), sinew_ros2_core::CatalogError>(())
/// ```
#[derive(Clone, Debug, Default)]
pub struct Catalog {
    /// Messages, and the halves of services under their own names.
    definitions: BTreeMap<TypeName, Definition>,
}

impl Catalog {
    /// Returns a catalog of the definitions that are shipped.
    ///
    /// # Panics
    /// Never: a test adds them all.
    #[must_use]
    pub fn shipped() -> Self {
        let mut catalog = Self::default();
        for part in SHIPPED.split("=== ").skip(1) {
            let (name, text) = part.split_once('\n').unwrap_or((part, ""));
            catalog.add(name, text).expect("the definitions that are shipped are legal");
        }
        catalog
    }

    /// Adds a definition, in place of a former one of this name: the text of a `.msg` file for `pkg/msg/Name`, that of
    /// a `.srv` file for `pkg/srv/Name`.
    ///
    /// # Errors
    /// The name or the text is illegal, or the catalog is full.
    pub fn add(&mut self, name: &str, text: &str) -> Result<(), CatalogError> {
        if self.definitions.len() + 2 > DEFINITIONS_MAX {
            return Err(CatalogError::Full);
        }
        let name = TypeName::parse(name)?;
        if name.is_service() {
            let (request, response) = parse_service(&name, text)?;
            self.definitions.insert(request.name.clone(), request);
            self.definitions.insert(response.name.clone(), response);
        } else {
            let definition = parse_message(&name, text)?;
            self.definitions.insert(name, definition);
        }
        Ok(())
    }

    /// Returns a message type.
    ///
    /// # Errors
    /// It, or a type in it, is not known or not legal.
    pub fn message(&self, name: &str) -> Result<Arc<Structure>, CatalogError> {
        let mut members_left = MEMBERS_MAX;
        self.structure(&TypeName::parse(name)?, None, DEPTH_MAX, &mut members_left)
    }

    /// Returns a service type.
    ///
    /// # Errors
    /// It, or a type in it, is not known or not legal.
    pub fn service(&self, name: &str) -> Result<Service, CatalogError> {
        let name = TypeName::parse(name)?;
        let half = |suffix| self.message(name.with_suffix(suffix).as_str());
        let unknown = |why: CatalogError| {
            if matches!(why, CatalogError::Unknown { by: None, .. }) {
                CatalogError::Unknown { name: name.clone(), by: None }
            } else {
                why
            }
        };
        let (request, response) = (half("_Request").map_err(unknown)?, half("_Response").map_err(unknown)?);
        let info = self.message("service_msgs/msg/ServiceEventInfo")?;
        let of = |name: &str, message: &Arc<Structure>, count| Member {
            name: name.to_owned(),
            element: Element::Message(Arc::clone(message)),
            count,
        };
        let event = Arc::new(Structure {
            name: name.with_suffix("_Event"),
            members: vec![
                of("info", &info, Count::One),
                of("request", &request, Count::Bounded(1)),
                of("response", &response, Count::Bounded(1)),
            ],
        });
        let description = Arc::new(Structure {
            name: name.clone(),
            members: vec![
                of("request_message", &request, Count::One),
                of("response_message", &response, Count::One),
                of("event_message", &event, Count::One),
            ],
        });
        Ok(Service { name, request, response, description })
    }

    fn structure(
        &self,
        name: &TypeName,
        by: Option<&TypeName>,
        depth: usize,
        members_left: &mut usize,
    ) -> Result<Arc<Structure>, CatalogError> {
        let unknown = || CatalogError::Unknown { name: name.clone(), by: by.cloned() };
        let definition = self.definitions.get(name).ok_or_else(unknown)?;
        let nested = || CatalogError::Nested(name.clone());
        let depth = depth.checked_sub(1).ok_or_else(nested)?;
        *members_left = members_left.checked_sub(definition.fields.len()).ok_or_else(nested)?;
        let mut members = Vec::with_capacity(definition.fields.len());
        for Field { name: field, base, count } in &definition.fields {
            let element = match base {
                Base::Bool => Element::Bool,
                Base::Byte => Element::Byte,
                Base::Signed(bits) => Element::Signed(*bits),
                Base::Unsigned(bits) => Element::Unsigned(*bits),
                Base::Float(bits) => Element::Float(*bits),
                Base::Text(max) => Element::Text(*max),
                Base::Message(inner) => {
                    Element::Message(self.structure(inner, Some(name), depth, members_left)?)
                }
            };
            members.push(Member { name: field.clone(), element, count: *count });
        }
        Ok(Arc::new(Structure { name: name.clone(), members }))
    }
}

impl Structure {
    /// Returns the place and the member of this name.
    #[must_use]
    pub fn member(&self, name: &str) -> Option<(usize, &Member)> {
        self.members.iter().enumerate().find(|(_, member)| member.name == name)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shipped_types_can_be_made() {
        let catalog = Catalog::shipped();
        let names: Vec<_> = catalog.definitions.keys().map(TypeName::to_string).collect();
        for name in &names {
            assert!(catalog.message(name).is_ok(), "{name}");
        }
        for service in ["std_srvs/srv/Trigger", "rcl_interfaces/srv/SetParameters"] {
            assert!(catalog.service(service).is_ok(), "{service}");
        }
    }

    #[test]
    fn unknown_types_are_named() {
        let mut catalog = Catalog::default();
        catalog.add("demo_msgs/msg/Outer", "Inner[] all").expect("a definition");
        let why = catalog.message("demo_msgs/msg/Outer").expect_err("no inner one").to_string();
        assert!(why.contains("demo_msgs/msg/Inner is not known, and demo_msgs/msg/Outer refers"), "{why}");
        let why = catalog.service("demo_msgs/srv/Ask").expect_err("no service").to_string();
        assert!(why.starts_with("demo_msgs/srv/Ask is not known"), "{why}");
    }

    #[test]
    fn endless_and_exploding_types_are_refused() {
        let mut catalog = Catalog::default();
        catalog.add("demo_msgs/msg/Ring", "Ring next").expect("a definition");
        assert!(matches!(catalog.message("demo_msgs/msg/Ring"), Err(CatalogError::Nested(_))));
        for level in 0..14 {
            let text = format!("L{0} a\nL{0} b\nL{0} c", level + 1);
            catalog.add(&format!("demo_msgs/msg/L{level}"), &text).expect("a definition");
        }
        catalog.add("demo_msgs/msg/L14", "bool end").expect("a definition");
        assert!(matches!(catalog.message("demo_msgs/msg/L0"), Err(CatalogError::Nested(_))));
    }
}

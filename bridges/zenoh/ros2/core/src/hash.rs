//! RIHS01 hashes: the SHA-256 of the description of a type and of all types in it.

use std::collections::BTreeMap;

use hiroz_schema::{
    FieldDescription, FieldTypeDescription, TypeDescription, TypeDescriptionMsg, TypeId, calculate_hash,
};

use crate::catalog::{Count, Element, Member, Structure};

/// Returns the hash of a message, or of the description of a service, such as `RIHS01_705b..`.
#[must_use]
pub fn type_hash(of: &Structure) -> String {
    let mut referenced = BTreeMap::new();
    collect(of, &mut referenced);
    let described = TypeDescriptionMsg {
        type_description: describe(of),
        // In the order of their names.
        referenced_type_descriptions: referenced.into_values().collect(),
    };
    calculate_hash(&described).to_rihs_string()
}

fn collect<'s>(of: &'s Structure, referenced: &mut BTreeMap<&'s str, TypeDescription>) {
    for member in &of.members {
        if let Element::Message(inner) = &member.element
            && !referenced.contains_key(inner.name.as_str())
        {
            referenced.insert(inner.name.as_str(), describe(inner));
            collect(inner, referenced);
        }
    }
}

fn describe(of: &Structure) -> TypeDescription {
    TypeDescription {
        type_name: of.name.to_string(),
        fields: of.members.iter().map(describe_member).collect(),
    }
}

fn describe_member(member: &Member) -> FieldDescription {
    let (base, string_capacity, nested) = match &member.element {
        Element::Bool => (TypeId::BOOL, 0, ""),
        Element::Byte => (TypeId::BYTE, 0, ""),
        Element::Signed(8) => (TypeId::INT8, 0, ""),
        Element::Signed(16) => (TypeId::INT16, 0, ""),
        Element::Signed(32) => (TypeId::INT32, 0, ""),
        Element::Signed(_) => (TypeId::INT64, 0, ""),
        Element::Unsigned(8) => (TypeId::UINT8, 0, ""),
        Element::Unsigned(16) => (TypeId::UINT16, 0, ""),
        Element::Unsigned(32) => (TypeId::UINT32, 0, ""),
        Element::Unsigned(_) => (TypeId::UINT64, 0, ""),
        Element::Float(32) => (TypeId::FLOAT32, 0, ""),
        Element::Float(_) => (TypeId::FLOAT64, 0, ""),
        Element::Text(None) => (TypeId::STRING, 0, ""),
        Element::Text(Some(max)) => (TypeId::BOUNDED_STRING, u64::from(*max), ""),
        Element::Message(inner) => (TypeId::NESTED_TYPE, 0, inner.name.as_str()),
    };
    let (offset, capacity) = match member.count {
        Count::One => (0, 0),
        Count::Array(length) => (TypeId::ARRAY_OFFSET, u64::from(length)),
        Count::Bounded(max) => (TypeId::BOUNDED_SEQUENCE_OFFSET, u64::from(max)),
        Count::Unbounded => (TypeId::UNBOUNDED_SEQUENCE_OFFSET, 0),
    };
    FieldDescription {
        name: member.name.clone(),
        field_type: FieldTypeDescription {
            type_id: base + offset,
            capacity,
            string_capacity,
            nested_type_name: nested.to_owned(),
        },
        default_value: String::new(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::catalog::Catalog;

    /// Hashes as `rmw_zenoh` has them in its keys.
    #[test]
    fn hashes_are_those_of_ros() {
        let mut catalog = Catalog::shipped();
        catalog.add("std_msgs/msg/String", "string data").expect("a definition");
        for (name, hash) in [
            (
                "std_msgs/msg/String",
                "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
            ),
            (
                "std_msgs/msg/Float64",
                "RIHS01_705ba9c3d1a09df43737eb67095534de36fd426c0587779bda2bc51fe790182a",
            ),
            (
                "sensor_msgs/msg/JointState",
                "RIHS01_a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e",
            ),
            (
                "geometry_msgs/msg/Twist",
                "RIHS01_9c45bf16fe0983d80e3cfe750d6835843d265a9a6c46bd2e609fcddde6fb8d2a",
            ),
            (
                "sensor_msgs/msg/Imu",
                "RIHS01_7d9a00ff131080897a5ec7e26e315954b8eae3353c3f995c55faf71574000b5b",
            ),
        ] {
            assert_eq!(type_hash(&catalog.message(name).expect("a type")), hash, "{name}");
        }
    }

    #[test]
    fn hashes_of_services_are_those_of_ros() {
        let mut catalog = Catalog::shipped();
        let sum = "int64 a\nint64 b\n---\nint64 sum";
        catalog.add("example_interfaces/srv/AddTwoInts", sum).expect("a definition");
        for (name, hash) in [
            (
                "example_interfaces/srv/AddTwoInts",
                "RIHS01_e118de6bf5eeb66a2491b5bda11202e7b68f198d6f67922cf30364858239c81a",
            ),
            (
                "std_srvs/srv/Trigger",
                "RIHS01_eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f",
            ),
        ] {
            assert_eq!(type_hash(&catalog.service(name).expect("a service").description), hash, "{name}");
        }
    }
}

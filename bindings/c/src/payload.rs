//! Typed payloads: the MessagePack form of a C struct, by a table of its fields.
//!
//! A struct is written as a map with the names of its fields, like Rust's `payload!` types. Reading is
//! strict: a field that is missing, has another type or does not fit is rejected with its name, and nothing
//! is rounded to infinity or cut off. A type without fields is written as an empty array, and read from an
//! empty array, an empty map, nil, or no bytes.

use std::{
    ffi::{CStr, c_char},
    mem::MaybeUninit,
};

use sinew_runtime::{tid::Tid, wire::Kind};

use crate::{
    ffi_boundary::{call, present, write},
    message::{Endpoint, Message, Received, TidBits},
    registration::with,
    status::{CallError, Status},
    text::{self, Text},
};

mod decode;
mod encode;
mod struct_memory;
#[cfg(test)]
mod tests;

use struct_memory::{StructMemory, StructMemoryMut};

/// Maximum number of fields of one struct.
const FIELDS_MAX: usize = 64;
/// Maximum nesting depth of structs.
const DEPTH_MAX: usize = 8;

/// The type of a field, or of the elements of an array. In C, `SINEW_FIELD` finds it by itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
#[allow(
    clippy::enum_variant_names,
    dead_code,
    reason = "these are the names in C, which hands their numbers in"
)]
pub enum FieldType {
    /// `bool`.
    SinewTypeBool = 1,
    /// `int8_t`.
    SinewTypeI8 = 2,
    /// `int16_t`.
    SinewTypeI16 = 3,
    /// `int32_t`.
    SinewTypeI32 = 4,
    /// `int64_t`.
    SinewTypeI64 = 5,
    /// `uint8_t`.
    SinewTypeU8 = 6,
    /// `uint16_t`.
    SinewTypeU16 = 7,
    /// `uint32_t`.
    SinewTypeU32 = 8,
    /// `uint64_t`.
    SinewTypeU64 = 9,
    /// `float`.
    SinewTypeF32 = 10,
    /// `double`.
    SinewTypeF64 = 11,
    /// An array of `char`: UTF-8 that ends with a zero.
    SinewTypeText = 12,
    /// An array of `uint8_t` that is written as bytes, not as a list of numbers.
    SinewTypeBytes = 13,
    /// A struct that has a table of its own.
    SinewTypeStruct = 14,
}

/// For `flags` of `sinew_field`: the field is an array. Without `SINEW_FIELD_COUNTED` all of its elements are
/// written and required.
pub const SINEW_FIELD_ARRAY: u32 = 1;
/// For `flags` of `sinew_field`: a `size_t` at `extra_offset` is the number of elements in use. Without it
/// all elements of the array are in use.
pub const SINEW_FIELD_COUNTED: u32 = 2;
/// For `flags` of `sinew_field`: a `bool` at `extra_offset` says whether the field has a value. Without one
/// it is written as `null`; when read it may also be missing. Rust's `Option`.
pub const SINEW_FIELD_OPTIONAL: u32 = 4;

/// A field of a struct. C: one of the macros `SINEW_FIELD`, `SINEW_FIELD_LIST`, `SINEW_FIELD_MAYBE`,
/// `SINEW_FIELD_STRUCT`, `SINEW_FIELD_STRUCTS`, `SINEW_FIELD_BYTES`. C++: `SINEW_PAYLOAD` and `SINEW_STRUCT`
/// of sinew.hpp write the whole table.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
pub struct Field {
    /// The name in the payload, a C string.
    pub name: *const c_char,
    /// Offset in the struct, in bytes.
    pub offset: usize,
    /// Length in bytes, with all elements of an array.
    pub size: usize,
    /// Offset of its count or its `bool`: see `flags`.
    pub extra_offset: usize,
    /// The table of its struct, for `SINEW_TYPE_STRUCT`; else NULL.
    pub layout: *const Layout,
    /// One of `sinew_field_type`.
    pub field_type: u32,
    /// `SINEW_FIELD_ARRAY`, `SINEW_FIELD_COUNTED`, `SINEW_FIELD_OPTIONAL`.
    pub flags: u32,
}

/// The table of a struct's fields. C: `SINEW_LAYOUT`; `SINEW_LAYOUT_EMPTY` for a struct without fields.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
pub struct Layout {
    /// The fields, at most 64; may be NULL if there are none.
    pub fields: *const Field,
    /// Number of fields; 0 for a type without fields.
    pub fields_count: usize,
    /// Length of the struct in bytes.
    pub size: usize,
}

/// A payload type: its name, its class, its fields, and its time to live. C: `SINEW_PAYLOAD`,
/// `SINEW_PAYLOAD_EXPIRING`; `SINEW_PAYLOAD_EMPTY`, `SINEW_PAYLOAD_EMPTY_EXPIRING` for a type without fields.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
pub struct PayloadType {
    /// The name, the same in every program and language.
    pub name: Text,
    /// One of `sinew_message_class`.
    pub message_class: i32,
    /// The fields.
    pub layout: Layout,
    /// Time to live: an older message expires in its queue, and is not received. 0: it never expires. At most
    /// 71 minutes and 35 s: more counts as that.
    pub expires_after_ns: u64,
}

impl Layout {
    /// The table's fields, which C keeps in place during the call.
    fn fields(&self) -> Result<&[Field], CallError> {
        if self.fields_count > FIELDS_MAX {
            let sentence =
                format!("a struct has {} fields; at most {FIELDS_MAX} are legal", self.fields_count);
            return Err(CallError::argument(sentence));
        }
        // SAFETY: the header requires that `fields_count` fields are valid during the call; the count was
        // checked.
        unsafe { text::memory(self.fields, self.fields_count) }
            .ok_or_else(|| CallError::argument("`fields` is NULL, but has a count"))
    }
}

impl Field {
    fn name(&self) -> Result<&str, CallError> {
        if self.name.is_null() {
            return Err(CallError::argument("the name of a field is NULL"));
        }
        // SAFETY: not NULL, and the header requires that it is a C string which stays during the call.
        unsafe { CStr::from_ptr(self.name) }
            .to_str()
            .map_err(|error| CallError::argument(format!("the name of a field is not UTF-8: {error}")))
    }

    /// The table of a field that is a struct.
    fn layout(&self) -> Result<&Layout, CallError> {
        // SAFETY: NULL, or the header requires that the table stays during the call.
        unsafe { self.layout.as_ref() }.ok_or_else(|| CallError::argument("the `layout` of a struct is NULL"))
    }

    const fn has(&self, flag: u32) -> bool {
        self.flags & flag != 0
    }

    /// Length of the value, or of one element of an array, in bytes.
    fn element_size(&self) -> Result<usize, CallError> {
        Ok(match self.field_type()? {
            FieldType::SinewTypeBool | FieldType::SinewTypeI8 | FieldType::SinewTypeU8 => 1,
            FieldType::SinewTypeI16 | FieldType::SinewTypeU16 => 2,
            FieldType::SinewTypeI32 | FieldType::SinewTypeU32 | FieldType::SinewTypeF32 => 4,
            FieldType::SinewTypeI64 | FieldType::SinewTypeU64 | FieldType::SinewTypeF64 => 8,
            FieldType::SinewTypeText | FieldType::SinewTypeBytes => self.size,
            FieldType::SinewTypeStruct => self.layout()?.size,
        })
    }

    /// Number of elements that fit; 1 for a field that is no array.
    fn capacity(&self) -> Result<usize, CallError> {
        let element = self.element_size()?;
        let count = if self.has(SINEW_FIELD_ARRAY) { self.size / element.max(1) } else { 1 };
        if element == 0 || count.checked_mul(element) != Some(self.size) {
            let name = self.name()?;
            return Err(CallError::argument(format!("field `{name}`: its `size` does not fit its type")));
        }
        Ok(count)
    }

    fn field_type(&self) -> Result<FieldType, CallError> {
        const ALL: [FieldType; 14] = [
            FieldType::SinewTypeBool,
            FieldType::SinewTypeI8,
            FieldType::SinewTypeI16,
            FieldType::SinewTypeI32,
            FieldType::SinewTypeI64,
            FieldType::SinewTypeU8,
            FieldType::SinewTypeU16,
            FieldType::SinewTypeU32,
            FieldType::SinewTypeU64,
            FieldType::SinewTypeF32,
            FieldType::SinewTypeF64,
            FieldType::SinewTypeText,
            FieldType::SinewTypeBytes,
            FieldType::SinewTypeStruct,
        ];
        ALL.into_iter().find(|known| *known as u32 == self.field_type).ok_or_else(|| {
            let code = self.field_type;
            CallError::argument(format!("`field_type` is {code}: take one of sinew_field_type"))
        })
    }
}

impl PayloadType {
    fn kind(&self) -> Result<Kind, CallError> {
        Ok(Kind::named(self.name.read("name")?))
    }
}

/// Rejects structs that are nested too deep.
fn check_depth(depth: usize) -> Result<(), CallError> {
    if depth < DEPTH_MAX {
        return Ok(());
    }
    Err(CallError::argument(format!("structs are nested deeper than {DEPTH_MAX}")))
}

/// Creates a message with a typed value: `*value` is a struct of this type; `value` may be NULL for a type
/// without fields. The type gives the class and the time to live. The bytes are MessagePack with the names of
/// the fields, which Rust reads as the `payload!` of the same name. Pass the message to any function that
/// sends, like one of `sinew_create_message`. `SINEW_ERROR_INVALID_ARGUMENT` with the field's name if the
/// value cannot be written: a text that is not UTF-8, a count above the array. Does not block. The endpoint's
/// thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_create_value(
    endpoint: *mut Endpoint,
    destination: TidBits,
    payload_type: Option<&PayloadType>,
    value: *const std::ffi::c_void,
    message: Option<&mut MaybeUninit<Message>>,
) -> Status {
    call(|| {
        let message = present(message, "message")?;
        let payload_type = present(payload_type, "payload_type")?;
        let value = StructMemory::new(value, &payload_type.layout)?;
        let (kind, length) = (payload_type.kind()?, encode::length(&payload_type.layout, value)?);
        let destination = Tid::from_bits(destination);
        let created = with(endpoint, |session| {
            let created =
                session.create_with((destination, kind, payload_type.message_class), length, |bytes| {
                    encode::write(&payload_type.layout, value, bytes).map(|_| ())
                })?;
            match payload_type.expires_after_ns {
                0 => {}
                time => session.set_expires_after(&created, time)?,
            }
            Ok(created)
        })?;
        Ok(write(message, created))
    })
}

/// Reads a received message as a typed value: `*value` is a struct of this type, which is written if this
/// returns `SINEW_OK`. `value` may be NULL for a type without fields; nothing is written then.
/// `SINEW_NOTHING` if the message is of another kind. `SINEW_ERROR_MALFORMED` with the field's name if it
/// cannot be read: the field is missing, of another type, or its value does not fit. Then settle the message
/// as `SINEW_REJECTED_MALFORMED`. Fields that the type does not have are skipped. Any thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_read_value(
    received: Option<&Received>,
    payload_type: Option<&PayloadType>,
    value: *mut std::ffi::c_void,
) -> Status {
    call(|| {
        let received = present(received, "received")?;
        let payload_type = present(payload_type, "payload_type")?;
        if received.kind != payload_type.kind()?.bits() {
            return Ok(Status::SinewNothing);
        }
        // SAFETY: the header requires that the bytes of a message are used only until it is settled.
        let bytes = unsafe { text::memory(received.bytes, received.length) }
            .ok_or_else(|| CallError::argument("`received` has no bytes: was it settled?"))?;
        read(payload_type, bytes, value)
    })
}

/// Writes a typed value as MessagePack to `bytes`, which has room for `room` bytes, for a protected payload,
/// a file, or a bus of your own. `*length` is the length of the encoded value, also if this returns
/// `SINEW_ERROR_TOO_LONG` because there is less room. `bytes` may be NULL if `room` is 0. Any thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_encode_value(
    payload_type: Option<&PayloadType>,
    value: *const std::ffi::c_void,
    bytes: *mut u8,
    room: usize,
    length: Option<&mut MaybeUninit<usize>>,
) -> Status {
    call(|| {
        let length = present(length, "length")?;
        let layout = &present(payload_type, "payload_type")?.layout;
        let value = StructMemory::new(value, layout)?;
        let needed = encode::length(layout, value)?;
        length.write(needed);
        if needed > room {
            let sentence = format!("the value has {needed} bytes, and `room` is {room}");
            return Err(CallError::new(Status::SinewErrorTooLong, sentence));
        }
        // SAFETY: the header requires that `bytes` has room for `room` bytes, and this is at most that.
        let memory = unsafe { text::memory_mut(bytes, needed) }
            .ok_or_else(|| CallError::argument("`bytes` is NULL, but has room"))?;
        encode::write(layout, value, memory).map(|_| Status::SinewOk)
    })
}

/// Reads a typed value from MessagePack, as `sinew_read_value` does from a message. Any thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_decode_value(
    payload_type: Option<&PayloadType>,
    bytes: *const u8,
    length: usize,
    value: *mut std::ffi::c_void,
) -> Status {
    call(|| {
        let payload_type = present(payload_type, "payload_type")?;
        // SAFETY: the header requires that `length` bytes are valid during the call.
        let bytes = unsafe { text::memory(bytes, length) }
            .ok_or_else(|| CallError::argument("`bytes` is NULL, but has a length"))?;
        read(payload_type, bytes, value)
    })
}

/// Reads into memory of this function first, so that a value which cannot be read leaves the caller's
/// unchanged.
fn read(payload_type: &PayloadType, bytes: &[u8], value: *mut std::ffi::c_void) -> Result<Status, CallError> {
    let layout = &payload_type.layout;
    let mut value = StructMemoryMut::new(value, layout)?;
    decode::check(layout, bytes, payload_type.name.read("name")?)?;
    decode::read(layout, bytes, &mut value)?;
    Ok(Status::SinewOk)
}

//! Typed payloads: the MessagePack form of a C struct, by a table of its fields.
//!
//! A struct is written as a map with the names of its fields, as Rust's `payload!` types are. Reading is strict: a field that is
//! missing, has another type or does not fit is refused with its name, and nothing is rounded to infinity or cut off.

use std::{
    ffi::{CStr, c_char},
    mem::MaybeUninit,
};

use sinew::{Tid, message::Kind};

use crate::{
    border::{call, present, write},
    message::{Endpoint, Message, Received, TidBits},
    registration::with,
    status::{Fault, Status},
    text::{self, Text},
};

mod decode;
mod encode;
mod struct_memory;
#[cfg(test)]
mod tests;

use struct_memory::{StructMemory, StructMemoryMut};

/// Fields of one struct at most.
const FIELDS_MAX: usize = 64;
/// Structs in structs at most.
const DEPTH_MAX: usize = 8;

/// The type of a field, and of the elements of one that is an array. C has `SINEW_FIELD`, which finds it by itself.
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

/// For `flags` of `sinew_field`: the field is an array; without `SINEW_FIELD_COUNTED` all of its elements are written and wanted.
pub const SINEW_FIELD_ARRAY: u32 = 1;
/// For `flags` of `sinew_field`: a `size_t` at `extra_offset` says how many elements of the array are in use. Without it an array
/// has as many elements as fit.
pub const SINEW_FIELD_COUNTED: u32 = 2;
/// For `flags` of `sinew_field`: a `bool` at `extra_offset` says whether the field has a value. It is `null` without one, and may be
/// missing in what is read. Rust's `Option`.
pub const SINEW_FIELD_OPTIONAL: u32 = 4;

/// A field of a struct. C: one of the macros `SINEW_FIELD`, `SINEW_FIELD_LIST`, `SINEW_FIELD_MAYBE`, `SINEW_FIELD_STRUCT`,
/// `SINEW_FIELD_STRUCTS`, `SINEW_FIELD_BYTES`. C++: `SINEW_PAYLOAD` and `SINEW_STRUCT` of sinew.hpp write the whole table.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
pub struct Field {
    /// Its name in the payload, a C string.
    pub name: *const c_char,
    /// Where it is in the struct, in bytes.
    pub offset: usize,
    /// Its length in bytes, with all elements of an array.
    pub size: usize,
    /// Where its count or its `bool` is: see `flags`.
    pub extra_offset: usize,
    /// The table of its struct, for `SINEW_TYPE_STRUCT`; else NULL.
    pub layout: *const Layout,
    /// One of `sinew_field_type`.
    pub field_type: u32,
    /// `SINEW_FIELD_ARRAY`, `SINEW_FIELD_COUNTED`, `SINEW_FIELD_OPTIONAL`.
    pub flags: u32,
}

/// The table of a struct's fields. C: `SINEW_LAYOUT`.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
pub struct Layout {
    /// Its fields, 64 at most.
    pub fields: *const Field,
    /// How many there are.
    pub fields_count: usize,
    /// Length of the struct in bytes.
    pub size: usize,
}

/// A type of payloads: its name, the class in which it is sent, its fields, and its time to live. C: `SINEW_PAYLOAD`,
/// `SINEW_PAYLOAD_EXPIRING`.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
pub struct PayloadType {
    /// Its name, the same in every program and language.
    pub name: Text,
    /// One of `sinew_message_class`.
    pub message_class: i32,
    /// Its fields.
    pub layout: Layout,
    /// Time to live: a message that is older expires where it waits, and is not received. 0: it has none. At most 71 minutes and 35 s: more
    /// counts as that.
    pub expires_after_ns: u64,
}

impl Layout {
    /// The table's fields, which C keeps where they are while the call lasts.
    fn fields(&self) -> Result<&[Field], Fault> {
        if self.fields_count > FIELDS_MAX {
            let sentence =
                format!("a struct has {} fields; at most {FIELDS_MAX} are legal", self.fields_count);
            return Err(Fault::argument(sentence));
        }
        // SAFETY: the header asks of the caller that so many fields are there while the call lasts; how many, was checked.
        unsafe { text::memory(self.fields, self.fields_count) }
            .ok_or_else(|| Fault::argument("`fields` is NULL, but has a count"))
    }
}

impl Field {
    fn name(&self) -> Result<&str, Fault> {
        if self.name.is_null() {
            return Err(Fault::argument("the name of a field is NULL"));
        }
        // SAFETY: not NULL, and the header asks of the caller that it is a C string which stays while the call lasts.
        unsafe { CStr::from_ptr(self.name) }
            .to_str()
            .map_err(|error| Fault::argument(format!("the name of a field is not UTF-8: {error}")))
    }

    /// The table of a field that is a struct.
    fn layout(&self) -> Result<&Layout, Fault> {
        // SAFETY: NULL, or the header asks of the caller that the table stays while the call lasts.
        unsafe { self.layout.as_ref() }.ok_or_else(|| Fault::argument("the `layout` of a struct is NULL"))
    }

    const fn has(&self, flag: u32) -> bool {
        self.flags & flag != 0
    }

    /// Length of the value, or of one element of an array, in bytes.
    fn element_size(&self) -> Result<usize, Fault> {
        Ok(match self.field_type()? {
            FieldType::SinewTypeBool | FieldType::SinewTypeI8 | FieldType::SinewTypeU8 => 1,
            FieldType::SinewTypeI16 | FieldType::SinewTypeU16 => 2,
            FieldType::SinewTypeI32 | FieldType::SinewTypeU32 | FieldType::SinewTypeF32 => 4,
            FieldType::SinewTypeI64 | FieldType::SinewTypeU64 | FieldType::SinewTypeF64 => 8,
            FieldType::SinewTypeText | FieldType::SinewTypeBytes => self.size,
            FieldType::SinewTypeStruct => self.layout()?.size,
        })
    }

    /// How many elements fit; 1 for a field that is no array.
    fn capacity(&self) -> Result<usize, Fault> {
        let element = self.element_size()?;
        let count = if self.has(SINEW_FIELD_ARRAY) { self.size / element.max(1) } else { 1 };
        if element == 0 || count.checked_mul(element) != Some(self.size) {
            let name = self.name()?;
            return Err(Fault::argument(format!("field `{name}`: its `size` does not fit its type")));
        }
        Ok(count)
    }

    fn field_type(&self) -> Result<FieldType, Fault> {
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
            Fault::argument(format!("`field_type` is {code}: take one of sinew_field_type"))
        })
    }
}

impl PayloadType {
    fn kind(&self) -> Result<Kind, Fault> {
        Ok(Kind::named(self.name.read("name")?))
    }
}

/// Refuses structs that are nested too deep.
fn check_depth(depth: usize) -> Result<(), Fault> {
    if depth < DEPTH_MAX {
        return Ok(());
    }
    Err(Fault::argument(format!("structs are nested deeper than {DEPTH_MAX}")))
}

/// Creates a message with a typed value: `*value` is a struct of this type. Its class and its time to live are the type's, its bytes are MessagePack with the
/// names of the fields, which Rust reads as the `payload!` of the same name. Hand it to any function that sends, as one of
/// `sinew_create_message`. `SINEW_ERROR_INVALID_ARGUMENT` with the field's name where the value cannot be written: a text that is
/// not UTF-8, a count above the array. Does not block. The endpoint's thread.
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

/// Reads a received message as a typed value: `*value` is a struct of this type, which is written if this returns `SINEW_OK`.
/// `SINEW_NOTHING` if the message is of another kind. `SINEW_ERROR_MALFORMED` with the field's name if it cannot be read: a field
/// that is missing, of another type, or whose value does not fit. Settle the message then as `SINEW_REJECTED_MALFORMED`. Fields
/// that the type does not have are skipped. Any thread.
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
        // SAFETY: the header asks of the caller that the bytes of a message in hand are used while it is in hand.
        let bytes = unsafe { text::memory(received.bytes, received.length) }
            .ok_or_else(|| Fault::argument("`received` has no bytes: was it settled?"))?;
        read(payload_type, bytes, value)
    })
}

/// Writes a typed value as MessagePack to `bytes`, which has room for `room` bytes, for a protected payload, a file, or a bus of
/// your own. `*length` is the length that the value has, also where this returns `SINEW_ERROR_TOO_LONG`, since there is less
/// room. `bytes` may be NULL if `room` is 0. Any thread.
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
            return Err(Fault::new(Status::SinewErrorTooLong, sentence));
        }
        // SAFETY: the header asks of the caller that `bytes` has room for `room` bytes, of which these are the first.
        let memory = unsafe { text::memory_mut(bytes, needed) }
            .ok_or_else(|| Fault::argument("`bytes` is NULL, but has room"))?;
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
        // SAFETY: the header asks of the caller that so many bytes are there while the call lasts.
        let bytes = unsafe { text::memory(bytes, length) }
            .ok_or_else(|| Fault::argument("`bytes` is NULL, but has a length"))?;
        read(payload_type, bytes, value)
    })
}

/// Reads into memory of this function's own first, so that a value which cannot be read changes nothing of the caller's.
fn read(payload_type: &PayloadType, bytes: &[u8], value: *mut std::ffi::c_void) -> Result<Status, Fault> {
    let layout = &payload_type.layout;
    let mut value = StructMemoryMut::new(value, layout)?;
    decode::check(layout, bytes, payload_type.name.read("name")?)?;
    decode::read(layout, bytes, &mut value)?;
    Ok(Status::SinewOk)
}

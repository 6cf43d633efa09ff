//! Directories and values of an EXIF block, which is laid out as a TIFF file.
//!
//! A directory is a list of entries of twelve bytes: a tag, a type, a number of values, and the
//! values or where they are. Offsets count from the beginning of the block. Each directory is read
//! where the caller asks for it, so a block cannot lead in a circle.

/// Most entries of a directory that are looked at; cameras write at most about a hundred.
const MAX_ENTRIES: usize = 512;
const ENTRY_BYTES: usize = 12;
/// Longest text that is read.
const MAX_TEXT_BYTES: usize = 128;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum ByteOrder {
    Little,
    Big,
}

impl ByteOrder {
    fn u16(self, bytes: [u8; 2]) -> u16 {
        match self {
            Self::Little => u16::from_le_bytes(bytes),
            Self::Big => u16::from_be_bytes(bytes),
        }
    }

    fn u32(self, bytes: [u8; 4]) -> u32 {
        match self {
            Self::Little => u32::from_le_bytes(bytes),
            Self::Big => u32::from_be_bytes(bytes),
        }
    }

    fn u64(self, bytes: [u8; 8]) -> u64 {
        match self {
            Self::Little => u64::from_le_bytes(bytes),
            Self::Big => u64::from_be_bytes(bytes),
        }
    }
}

/// An EXIF block.
#[derive(Debug, Clone, Copy)]
pub(super) struct Tiff<'a> {
    bytes: &'a [u8],
    order: ByteOrder,
}

impl<'a> Tiff<'a> {
    /// `None` if it does not begin with the header.
    pub(super) fn new(bytes: &'a [u8]) -> Option<Self> {
        let order = match bytes.first_chunk()? {
            b"II*\0" => ByteOrder::Little,
            b"MM\0*" => ByteOrder::Big,
            _ => return None,
        };
        Some(Self { bytes, order })
    }

    /// The fields with these tags in the directory to which the header points.
    pub(super) fn first_directory(&self, tags: &[u16]) -> Directory<'a> {
        let at = self.bytes.get(4..).and_then(|rest| rest.first_chunk());
        let at = at.map_or(0, |bytes| self.order.u32(*bytes));
        self.directory(at, tags)
    }

    /// The fields with these tags in the directory to which the field `pointer` of `parent` points.
    pub(super) fn child_directory(
        &self,
        parent: &Directory<'a>,
        pointer: u16,
        tags: &[u16],
    ) -> Option<Directory<'a>> {
        let at = parent.field(pointer)?.offset()?;
        Some(self.directory(at, tags))
    }

    /// Of a directory that is cut off, the entries that are there.
    fn directory(&self, at: u32, tags: &[u16]) -> Directory<'a> {
        let mut directory = Directory::default();
        let rest = self.bytes.get(at as usize..).unwrap_or_default();
        let Some((count, rest)) = rest.split_first_chunk() else {
            return directory;
        };
        let count = usize::from(self.order.u16(*count)).min(MAX_ENTRIES);
        let (entries, _) = rest.as_chunks::<ENTRY_BYTES>();
        for entry in entries.iter().take(count) {
            let tag = self.order.u16([entry[0], entry[1]]);
            if tags.contains(&tag)
                && directory.field(tag).is_none()
                && let Some(field) = self.field(entry)
            {
                directory.0.push((tag, field));
            }
        }
        directory
    }

    /// The values of an entry; `None` if the type is unknown or the values lie outside the block.
    fn field(&self, entry: &'a [u8; ENTRY_BYTES]) -> Option<Field<'a>> {
        let [_, _, k0, k1, c0, c1, c2, c3, values @ ..] = entry;
        let kind = Kind::of(self.order.u16([*k0, *k1]))?;
        let count = self.order.u32([*c0, *c1, *c2, *c3]) as usize;
        let length = count.checked_mul(kind.bytes())?;
        let data = if length <= values.len() {
            &values[..length]
        } else {
            let at = self.order.u32(*values) as usize;
            self.bytes.get(at..at.checked_add(length)?)?
        };
        Some(Field {
            kind,
            data,
            order: self.order,
        })
    }
}

/// Fields of a directory, of each tag the first that can be read.
#[derive(Debug, Clone, Default)]
pub(super) struct Directory<'a>(Vec<(u16, Field<'a>)>);

impl<'a> Directory<'a> {
    pub(super) fn field(&self, tag: u16) -> Option<Field<'a>> {
        let found = self.0.iter().find(|(known, _)| *known == tag);
        found.map(|(_, field)| *field)
    }
}

/// Types of values.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Byte,
    Text,
    Short,
    Long,
    Rational,
    SignedByte,
    /// Bytes without a meaning of their own; some cameras put text there.
    Undefined,
    SignedShort,
    SignedLong,
    SignedRational,
    Float,
    Double,
}

impl Kind {
    fn of(number: u16) -> Option<Self> {
        Some(match number {
            1 => Self::Byte,
            // The second is UTF-8, which EXIF 3.0 added.
            2 | 129 => Self::Text,
            3 => Self::Short,
            // The second is a pointer to a directory.
            4 | 13 => Self::Long,
            5 => Self::Rational,
            6 => Self::SignedByte,
            7 => Self::Undefined,
            8 => Self::SignedShort,
            9 => Self::SignedLong,
            10 => Self::SignedRational,
            11 => Self::Float,
            12 => Self::Double,
            _ => return None,
        })
    }

    /// Bytes of one value.
    fn bytes(self) -> usize {
        match self {
            Self::Byte | Self::Text | Self::SignedByte | Self::Undefined => 1,
            Self::Short | Self::SignedShort => 2,
            Self::Long | Self::SignedLong | Self::Float => 4,
            Self::Rational | Self::SignedRational | Self::Double => 8,
        }
    }
}

/// The values of a tag.
#[derive(Debug, Clone, Copy)]
pub(super) struct Field<'a> {
    kind: Kind,
    data: &'a [u8],
    order: ByteOrder,
}

impl Field<'_> {
    /// One value as a number of whatever type, counted from 0. A fraction of 0/0 is not a number;
    /// another with a denominator of 0 is infinite. `None` if there is no such value.
    pub(super) fn number(&self, index: usize) -> Option<f64> {
        let size = self.kind.bytes();
        let value = self.data.chunks_exact(size).nth(index)?;
        let u32_at = |at: usize| {
            let bytes = value.get(at..)?.first_chunk()?;
            Some(self.order.u32(*bytes))
        };
        // Reinterprets the bits of a signed number.
        let i32_at = |at: usize| u32_at(at).map(u32::cast_signed);
        let u16 = || Some(self.order.u16(*value.first_chunk()?));
        Some(match self.kind {
            Kind::Byte => f64::from(*value.first()?),
            Kind::SignedByte => f64::from(value.first()?.cast_signed()),
            Kind::Short => f64::from(u16()?),
            Kind::SignedShort => f64::from(u16()?.cast_signed()),
            Kind::Long => f64::from(u32_at(0)?),
            Kind::SignedLong => f64::from(i32_at(0)?),
            Kind::Rational => f64::from(u32_at(0)?) / f64::from(u32_at(4)?),
            Kind::SignedRational => f64::from(i32_at(0)?) / f64::from(i32_at(4)?),
            Kind::Float => f64::from(f32::from_bits(u32_at(0)?)),
            Kind::Double => f64::from_bits(self.order.u64(*value.first_chunk()?)),
            Kind::Text | Kind::Undefined => return None,
        })
    }

    /// Its values as text, up to the first zero byte and without spaces around it; `None` if
    /// nothing is left.
    pub(super) fn text(&self) -> Option<String> {
        if !matches!(self.kind, Kind::Text | Kind::Undefined | Kind::Byte) {
            return None;
        }
        let bytes = &self.data[..self.data.len().min(MAX_TEXT_BYTES)];
        let text = bytes.split(|&byte| byte == 0).next()?;
        let text = String::from_utf8_lossy(text).trim().to_owned();
        (!text.is_empty()).then_some(text)
    }

    fn offset(&self) -> Option<u32> {
        let is_pointer = self.kind == Kind::Long;
        let bytes = self.data.first_chunk().filter(|_| is_pointer)?;
        Some(self.order.u32(*bytes))
    }
}

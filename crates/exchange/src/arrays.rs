//! Reads and writes NumPy arrays in a zip archive (`.npz`).
//!
//! Format: `numpy.lib.format` (NEP 1). Object arrays are pickles, which are programs: they are rejected by their
//! header, and their bytes are never read.
//!
//! The feature `npz` of npyz would bring zip 0.6 with bzip2, AES and a second zstd; zip 9 with deflate is enough.

use std::{
    fs::File,
    io::{BufReader, BufWriter, Read, Write},
    path::{Path, PathBuf},
};

use npyz::{
    AutoSerialize, DType, Endianness, NpyHeader, Order, TypeChar, TypeStr, WriteOptions,
    WriterBuilder,
};
use zip::{CompressionMethod, ZipArchive, ZipWriter, result::ZipError, write::SimpleFileOptions};

use super::error::ExchangeError;
use eddy_dataset::available_memory;

/// The number types that are read.
const NUMBERS: &str = "an array of numbers (f4, f8, i1 to i8 or u1 to u8)";

/// Writes an archive array by array, uncompressed as `numpy.savez` does.
pub(super) struct ArchiveWriter {
    zip: ZipWriter<BufWriter<File>>,
    path: PathBuf,
}

impl ArchiveWriter {
    pub(super) fn create(path: &Path) -> Result<Self, ExchangeError> {
        let file = File::create_new(path).map_err(ExchangeError::io(path, "creating the file"))?;
        Ok(Self { zip: ZipWriter::new(BufWriter::new(file)), path: path.into() })
    }

    /// Writes an array of `shape`, in C order.
    pub(super) fn array<T: AutoSerialize>(
        &mut self,
        name: &str,
        shape: &[usize],
        values: impl IntoIterator<Item = T>,
    ) -> Result<(), ExchangeError> {
        self.start(name)?;
        let failed = ExchangeError::io(&self.path, "writing");
        let write = |zip: &mut ZipWriter<_>| {
            let mut numbers = BufWriter::new(zip);
            let options = WriteOptions::new().default_dtype().shape(&extents(shape));
            let mut array = options.writer(&mut numbers).begin_nd()?;
            array.extend(values)?;
            array.finish()?;
            numbers.flush()
        };
        write(&mut self.zip).map_err(failed)
    }

    /// Starts an array of any type, in C order; its bytes follow with [`Self::bytes`].
    pub(super) fn begin(
        &mut self,
        name: &str,
        dtype: DType,
        shape: &[usize],
    ) -> Result<(), ExchangeError> {
        self.start(name)?;
        let options = WriteOptions::new_header_only().dtype(dtype).shape(&extents(shape));
        let written = options.writer(&mut self.zip).write_header_only();
        written.map(drop).map_err(ExchangeError::io(&self.path, "writing"))
    }

    /// Appends bytes to the array that was started.
    pub(super) fn bytes(&mut self, bytes: &[u8]) -> Result<(), ExchangeError> {
        self.zip.write_all(bytes).map_err(ExchangeError::io(&self.path, "writing"))
    }

    fn start(&mut self, name: &str) -> Result<(), ExchangeError> {
        // With 64-bit sizes, as in archives written by NumPy.
        let options = SimpleFileOptions::default()
            .compression_method(CompressionMethod::Stored)
            .large_file(true);
        let started = self.zip.start_file(format!("{name}.npy"), options);
        started.map_err(|error| zip_error(&self.path, error))
    }

    pub(super) fn finish(self) -> Result<(), ExchangeError> {
        let Self { zip, path } = self;
        let mut file = zip.finish().map_err(|error| zip_error(&path, error))?;
        file.flush().map_err(ExchangeError::io(&path, "writing"))
    }
}

fn extents(shape: &[usize]) -> Vec<u64> {
    shape.iter().map(|&extent| extent as u64).collect()
}

fn zip_error(path: &Path, error: ZipError) -> ExchangeError {
    match error {
        ZipError::Io(reason) if reason.kind() != std::io::ErrorKind::UnexpectedEof => {
            ExchangeError::Io { path: path.into(), action: "opening the archive", reason }
        }
        other => ExchangeError::File {
            path: path.into(),
            found: format!("no complete zip archive ({other})"),
            expected: "an .npz file",
        },
    }
}

/// An archive opened for reading.
pub(super) struct Archive {
    zip: ZipArchive<BufReader<File>>,
    path: PathBuf,
}

/// The numbers of an array, in C order.
#[derive(Debug, PartialEq)]
pub(super) struct Array<T> {
    pub(super) shape: Vec<usize>,
    pub(super) values: Vec<T>,
}

impl Archive {
    pub(super) fn open(path: &Path) -> Result<Self, ExchangeError> {
        let file = File::open(path).map_err(ExchangeError::io(path, "opening the file"))?;
        let zip = ZipArchive::new(BufReader::new(file)).map_err(|error| zip_error(path, error))?;
        Ok(Self { zip, path: path.into() })
    }

    /// The names of its arrays.
    pub(super) fn names(&self) -> Vec<String> {
        let names = self.zip.file_names().filter_map(|name| {
            let name = name.ok()?;
            Some(name.strip_suffix(".npy").unwrap_or(&name).to_owned())
        });
        names.collect()
    }

    /// Whether the archive has the array.
    pub(super) fn has(&self, name: &str) -> bool {
        self.zip.index_for_name(&format!("{name}.npy")).is_some()
    }

    /// Reads an array of numbers; `None` when the archive does not have it.
    pub(super) fn read<T: Number>(
        &mut self,
        name: &str,
    ) -> Result<Option<Array<T>>, ExchangeError> {
        if !self.has(name) {
            return Ok(None);
        }
        let entry = self.zip.by_name(&format!("{name}.npy"));
        let mut entry = entry.map_err(|error| zip_error(&self.path, error))?;
        let source = Source { path: &self.path, name };
        let header = source.header(&mut entry)?;
        let shape = source.shape(header.shape())?;
        let numeric = Numeric::of(&header.dtype())
            .ok_or_else(|| source.fault(format!("dtype {}", header.dtype().descr()), NUMBERS))?;
        let values = source.numbers(&mut entry, &numeric, &shape)?;
        source.end(&mut entry)?;
        let values = match header.order() {
            Order::C => values,
            Order::Fortran => in_c_order(&values, &shape),
        };
        Ok(Some(Array { shape, values }))
    }

    /// Calls `each` with the first two fields of each record of a structured array.
    pub(super) fn records<A: Number, B: Number>(
        &mut self,
        name: &str,
        mut each: impl FnMut(Array<A>, Array<B>) -> Result<(), ExchangeError>,
    ) -> Result<(), ExchangeError> {
        let entry = self.zip.by_name(&format!("{name}.npy"));
        let mut entry = entry.map_err(|error| zip_error(&self.path, error))?;
        let source = Source { path: &self.path, name };
        let header = source.header(&mut entry)?;
        if header.order() == Order::Fortran && header.shape().len() > 1 {
            let expected = "C order (numpy.ascontiguousarray makes it)";
            return Err(source.fault("Fortran order", expected));
        }
        let dtype = header.dtype();
        let expected = "a structured array with at least two fields of numbers";
        let fault = || source.fault(dtype.descr(), expected);
        let DType::Record(fields) = &dtype else { return Err(fault()) };
        let [first, second, rest @ ..] = fields.as_slice() else { return Err(fault()) };
        let (first, second) = (
            Numeric::of(&first.dtype).ok_or_else(fault)?,
            Numeric::of(&second.dtype).ok_or_else(fault)?,
        );
        let rest: usize = rest.iter().map(|field| field.dtype.num_bytes().unwrap_or(0)).sum();
        let records = source.length(&source.shape(header.shape())?)?;
        for _ in 0..records {
            let a = source.numbers(&mut entry, &first, &[])?;
            let b = source.numbers(&mut entry, &second, &[])?;
            source.skip(&mut entry, rest)?;
            each(
                Array { shape: first.shape.clone(), values: a },
                Array { shape: second.shape.clone(), values: b },
            )?;
        }
        source.end(&mut entry)
    }
}

/// File and array, for error messages.
struct Source<'a> {
    path: &'a Path,
    name: &'a str,
}

impl Source<'_> {
    fn fault(&self, found: impl Into<String>, expected: &str) -> ExchangeError {
        ExchangeError::Array {
            path: self.path.into(),
            array: self.name.into(),
            found: found.into(),
            expected: expected.into(),
        }
    }

    fn header(&self, entry: &mut impl Read) -> Result<NpyHeader, ExchangeError> {
        let header = NpyHeader::from_reader(entry)
            .map_err(|error| self.fault(error.to_string(), "the header of a .npy array"))?;
        if header.uses_pickled_array() {
            return Err(ExchangeError::Pickle { path: self.path.into(), array: self.name.into() });
        }
        Ok(header)
    }

    fn shape(&self, extents: &[u64]) -> Result<Vec<usize>, ExchangeError> {
        let shape: Result<Vec<usize>, _> = extents.iter().map(|&n| usize::try_from(n)).collect();
        shape.map_err(|_| self.fault(format!("shape {extents:?}"), "one that fits into memory"))
    }

    fn length(&self, shape: &[usize]) -> Result<usize, ExchangeError> {
        let length = shape.iter().try_fold(1usize, |product, &n| product.checked_mul(n));
        length.ok_or_else(|| self.fault(format!("shape {shape:?}"), "one that fits into memory"))
    }

    /// Reads an array of shape `outer` with elements of type `numeric`. Allocates for the bytes that are read, not
    /// for the shape in the header.
    fn numbers<T: Number>(
        &self,
        entry: &mut impl Read,
        numeric: &Numeric,
        outer: &[usize],
    ) -> Result<Vec<T>, ExchangeError> {
        let count = self.length(&[outer, &numeric.shape].concat())?;
        let bytes = self.length(&[count, numeric.size])?;
        // Of the bytes and the numbers: a few bytes of an archive may be the zeros of a large array.
        let needed = (count as u64).saturating_mul((numeric.size + size_of::<T>()) as u64);
        let available = available_memory();
        if needed > available {
            let found = format!("{count} numbers, which need {needed} bytes");
            return Err(self.fault(found, &format!("at most the {available} that are free")));
        }
        let mut raw = Vec::new();
        let read = entry.take(bytes as u64).read_to_end(&mut raw);
        // A wrong checksum, or a truncated archive.
        read.map_err(|error| self.fault(error.to_string(), "readable bytes"))?;
        if raw.len() < bytes {
            let found = format!("{} bytes of numbers", raw.len());
            return Err(self.fault(found, &format!("{bytes} according to its header")));
        }
        let values = raw.chunks_exact(numeric.size).map(|bytes| {
            let value = numeric.decode(bytes);
            let found = || format!("{} (dtype {})", value.describe(), numeric.dtype);
            T::from_value(value).ok_or_else(|| self.fault(found(), T::EXPECTED))
        });
        values.collect()
    }

    fn skip(&self, entry: &mut impl Read, bytes: usize) -> Result<(), ExchangeError> {
        let skipped = std::io::copy(&mut entry.take(bytes as u64), &mut std::io::sink());
        skipped.map(drop).map_err(|error| self.fault(error.to_string(), "readable bytes"))
    }

    /// Reads to the end, where the checksum of the archive is checked.
    fn end(&self, entry: &mut impl Read) -> Result<(), ExchangeError> {
        let rest = std::io::copy(entry, &mut std::io::sink())
            .map_err(|error| self.fault(error.to_string(), "readable bytes"))?;
        if rest > 0 {
            let found = format!("{rest} bytes after the numbers");
            return Err(self.fault(found, "none according to its header"));
        }
        Ok(())
    }
}

/// Sorts the values of an array in Fortran order, whose first index varies fastest.
fn in_c_order<T: Copy>(values: &[T], shape: &[usize]) -> Vec<T> {
    let strides = shape.iter().scan(1, |next, &extent| {
        let stride = *next;
        *next *= extent;
        Some(stride)
    });
    let strides: Vec<usize> = strides.collect();
    let mut place = vec![0; shape.len()];
    let mut sorted = Vec::with_capacity(values.len());
    for _ in values {
        sorted.push(
            values[place.iter().zip(&strides).map(|(index, stride)| index * stride).sum::<usize>()],
        );
        for (index, &extent) in place.iter_mut().zip(shape).rev() {
            *index += 1;
            if *index < extent {
                break;
            }
            *index = 0;
        }
    }
    sorted
}

/// A numeric element type, with a shape of its own in a structured array.
struct Numeric {
    /// Its name in NumPy.
    dtype: String,
    kind: TypeChar,
    /// Bytes of one number.
    size: usize,
    swapped: bool,
    shape: Vec<usize>,
}

impl Numeric {
    /// `None` for other types.
    fn of(dtype: &DType) -> Option<Self> {
        match dtype {
            DType::Plain(text) => Self::of_text(text),
            DType::Array(extent, inner) => {
                let mut numeric = Self::of(inner)?;
                numeric.shape.insert(0, usize::try_from(*extent).ok()?);
                Some(numeric)
            }
            DType::Record(_) => None,
        }
    }

    fn of_text(text: &TypeStr) -> Option<Self> {
        let (kind, size) = (text.type_char(), text.num_bytes()?);
        let known = match kind {
            TypeChar::Float => [4, 8].contains(&size),
            TypeChar::Int | TypeChar::Uint => [1, 2, 4, 8].contains(&size),
            _ => false,
        };
        let swapped = text.endianness() == Endianness::Big;
        let dtype = text.to_string();
        known.then_some(Self { dtype, kind, size, swapped, shape: Vec::new() })
    }

    fn decode(&self, bytes: &[u8]) -> Value {
        let mut raw = [0; 8];
        raw[..self.size].copy_from_slice(bytes);
        if self.swapped {
            raw[..self.size].reverse();
        }
        let unsigned = u64::from_le_bytes(raw);
        let unused = 64 - 8 * self.size as u32;
        match (self.kind, self.size) {
            (TypeChar::Float, 4) => Value::Float(f32::from_bits(unsigned as u32).into()),
            (TypeChar::Float, _) => Value::Float(f64::from_bits(unsigned)),
            (TypeChar::Int, _) => Value::Integer((((unsigned << unused) as i64) >> unused).into()),
            _ => Value::Integer(unsigned.into()),
        }
    }
}

/// A number of any NumPy type, without loss.
#[derive(Clone, Copy, Debug)]
pub(super) enum Value {
    Float(f64),
    Integer(i128),
}

impl Value {
    /// The number, if it is whole: also a float, as which programs save what they have calculated.
    fn whole(self) -> Option<i128> {
        match self {
            Self::Integer(number) => Some(number),
            // A larger one is no integer of 64 bits.
            Self::Float(number) => {
                (number.fract() == 0.0 && number.abs() < 1e20).then_some(number as i128)
            }
        }
    }

    fn describe(self) -> String {
        match self {
            Self::Float(number) => number.to_string(),
            Self::Integer(number) => number.to_string(),
        }
    }
}

/// Number types that arrays are read as.
pub(super) trait Number: Copy {
    /// For error messages.
    const EXPECTED: &str;
    fn from_value(value: Value) -> Option<Self>;
}

impl Number for f32 {
    const EXPECTED: &str = "a number";

    fn from_value(value: Value) -> Option<Self> {
        Some(match value {
            Value::Float(number) => number as Self,
            Value::Integer(number) => number as Self,
        })
    }
}

impl Number for i64 {
    const EXPECTED: &str = "an integer of 64 bits";

    fn from_value(value: Value) -> Option<Self> {
        value.whole()?.try_into().ok()
    }
}

impl Number for u64 {
    const EXPECTED: &str = "an integer from 0 to 2^64 - 1";

    fn from_value(value: Value) -> Option<Self> {
        value.whole()?.try_into().ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// An archive with one array, `x`, of this header and data.
    fn archive(folder: &Path, header: &str, data: &[u8]) -> PathBuf {
        let path = folder.join("x.npz");
        let mut zip = ZipWriter::new(File::create(&path).unwrap());
        zip.start_file("x.npy", SimpleFileOptions::default()).unwrap();
        zip.write_all(b"\x93NUMPY\x01\x00").unwrap();
        zip.write_all(&(header.len() as u16).to_le_bytes()).unwrap();
        zip.write_all(header.as_bytes()).unwrap();
        zip.write_all(data).unwrap();
        zip.finish().unwrap();
        path
    }

    fn header(descr: &str, shape: &str) -> String {
        format!("{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}\n")
    }

    #[test]
    fn numbers_of_every_type_and_byte_order_are_read() {
        let folder = tempfile::tempdir().unwrap();
        let cases: [(&str, &[u8], f32); 7] = [
            ("'<f4'", &1.5f32.to_le_bytes(), 1.5),
            ("'>f4'", &1.5f32.to_be_bytes(), 1.5),
            ("'<f8'", &(-0.25f64).to_le_bytes(), -0.25),
            ("'>i2'", &(-3i16).to_be_bytes(), -3.0),
            ("'|u1'", &[200], 200.0),
            ("'|i1'", &[0xff], -1.0),
            ("'<u8'", &7u64.to_le_bytes(), 7.0),
        ];
        for (descr, bytes, expected) in cases {
            let path = archive(folder.path(), &header(descr, "(1,)"), bytes);
            let array = Archive::open(&path).unwrap().read::<f32>("x").unwrap().unwrap();
            assert_eq!(array, Array { shape: vec![1], values: vec![expected] }, "{descr}");
        }
    }

    #[test]
    fn an_array_in_fortran_order_is_read_as_numpy_shows_it() {
        let folder = tempfile::tempdir().unwrap();
        // np.asfortranarray(np.arange(12).reshape(2, 3, 2)).tobytes("A")
        let stored: [u8; 12] = [0, 6, 2, 8, 4, 10, 1, 7, 3, 9, 5, 11];
        let header = header("'|u1'", "(2, 3, 2)").replace("False", "True");
        let path = archive(folder.path(), &header, &stored);
        let array = Archive::open(&path).unwrap().read::<i64>("x").unwrap().unwrap();
        assert_eq!(array, Array { shape: vec![2, 3, 2], values: (0..12).collect() });
    }

    #[test]
    fn whole_floats_are_integers_and_others_are_named_with_their_type() {
        let folder = tempfile::tempdir().unwrap();
        let read = |descr: &str, bytes: &[u8]| {
            let path = archive(folder.path(), &header(descr, "(1,)"), bytes);
            Archive::open(&path).unwrap().read::<i64>("x").map(|array| array.unwrap().values[0])
        };
        assert_eq!(read("'<f4'", &3f32.to_le_bytes()).unwrap(), 3);
        assert_eq!(read("'>f8'", &(-2f64).to_be_bytes()).unwrap(), -2);
        for (number, found) in [(0.5, "0.5"), (f64::NAN, "NaN"), (1e19, "10000000000000000000")] {
            let message = read("'<f8'", &number.to_le_bytes()).unwrap_err().to_string();
            let expected =
                format!("x.npz: x: found {found} (dtype <f8), expected an integer of 64 bits");
            assert!(message.ends_with(&expected), "{message}");
        }
    }

    #[test]
    fn unusable_arrays_are_rejected_with_name_and_reason() {
        let folder = tempfile::tempdir().unwrap();
        let four = [0; 4];
        let cases: [(&str, &[u8], &str); 8] = [
            (&header("'|O'", "(1,)"), b"cos\nsystem\n", "object arrays are pickles"),
            (&header("[('a', '|O')]", "(1,)"), b"", "object arrays are pickles"),
            (&header("'<U4'", "(1,)"), &[0; 16], "found dtype '<U4', expected an array of numbers"),
            (&header("'<f2'", "(1,)"), &[0; 2], "found dtype '<f2', expected an array of numbers"),
            (&header("'<f4'", "(2,)"), &four, "found 4 bytes of numbers, expected 8"),
            (&header("'<f4'", "(0,)"), &four, "found 4 bytes after the numbers"),
            (&header("'<f4'", "(1152921504606846975,)"), &four, "that are free"),
            (
                &header("'<f8'", "(9223372036854775807, 9)"),
                &four,
                "expected one that fits into memory",
            ),
        ];
        for (header, bytes, expected) in cases {
            let path = archive(folder.path(), header, bytes);
            let error = Archive::open(&path).unwrap().read::<f32>("x").unwrap_err().to_string();
            assert!(error.contains("x.npz: x: ") && error.contains(expected), "{error}");
        }
    }
}

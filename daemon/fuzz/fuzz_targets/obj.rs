//! Whatever the bytes, the OBJ reader gives an error or a valid mesh.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    if let Ok(file) = gv3::files::obj::parse_obj(bytes, std::path::Path::new("fuzz")) {
        file.mesh.validate().expect("a mesh that was read is valid");
    }
});

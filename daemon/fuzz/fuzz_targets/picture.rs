//! Whatever the bytes, the picture reader gives an error or a picture.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    let _ = gv3::files::picture::parse_picture(bytes, std::path::Path::new("fuzz"));
});

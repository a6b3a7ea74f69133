//! Raw bindings of Linux's `videodev2.h`, as the crate `v4l2-sys-mit` 0.3.0 makes them when it is built, made once.
//!
//! The structures are the kernel's interface and the same on every 64-bit machine; the sizes below prove it for the machine
//! at hand, since the number of an ioctl holds the size of its argument.
#![allow(clippy::all, non_camel_case_types, non_snake_case, non_upper_case_globals, missing_docs)]

#[cfg(not(all(target_os = "linux", target_pointer_width = "64")))]
compile_error!("these bindings are for 64-bit Linux; build gv3 without its feature v4l (--no-default-features)");

mod bindings;
pub use bindings::*;

const _: () = {
    use std::mem::size_of;
    assert!(size_of::<v4l2_capability>() == 104);
    assert!(size_of::<v4l2_fmtdesc>() == 64);
    assert!(size_of::<v4l2_format>() == 208);
    assert!(size_of::<v4l2_requestbuffers>() == 20);
    assert!(size_of::<v4l2_buffer>() == 88);
    assert!(size_of::<v4l2_streamparm>() == 204);
    assert!(size_of::<v4l2_query_ext_ctrl>() == 232);
    assert!(size_of::<v4l2_querymenu>() == 44);
    assert!(size_of::<v4l2_ext_control>() == 20);
    assert!(size_of::<v4l2_frmivalenum>() == 52);
    assert!(size_of::<v4l2_frmsizeenum>() == 44);
};

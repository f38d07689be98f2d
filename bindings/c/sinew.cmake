# For CMake, from a clone: include(.../bindings/c/sinew.cmake), then target_link_libraries(drive PRIVATE sinew::sinew).
# It links the static library, so that the program is one file.
find_package(Threads REQUIRED)
add_library(sinew::sinew STATIC IMPORTED)
set_target_properties(sinew::sinew PROPERTIES
    IMPORTED_LOCATION "${CMAKE_CURRENT_LIST_DIR}/../../target/release/libsinew_c.a"
    INTERFACE_INCLUDE_DIRECTORIES "${CMAKE_CURRENT_LIST_DIR}/include"
    INTERFACE_LINK_LIBRARIES "Threads::Threads;m;${CMAKE_DL_LIBS}")

"""Problems on a GPU: device functions of the compiled functions of the runtime, and the kernels that call them."""

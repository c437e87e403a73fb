void appMain(void);
